"""Goal-reaching tasks in JAX: the Fetch scenes on MJX, and the interface for a task of your own.

To import it changes nothing in the process, and to make a task does not start JAX.
"""

import contextlib
import io
import warnings

with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
    # brax imports MJX, which prints that Warp is missing, and jaxopt, which warns that it is old
    warnings.simplefilter("ignore", DeprecationWarning)
    from brax.envs.base import State

from hgail_envs.base import EpisodeMetrics, GoalEnv
from hgail_envs.checking import check_task
from hgail_envs.registry import TASKS, accepted_options, find_class, make, register_gymnasium

register_gymnasium()

__all__ = ["TASKS", "EpisodeMetrics", "GoalEnv", "State", "accepted_options", "check_task", "find_class", "make"]

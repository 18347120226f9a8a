"""Goal-reaching tasks in JAX: the Fetch scenes on MJX, and the interface for a task of one's own."""

from hgail_envs import workarounds

workarounds.prepare()  # before JAX starts, which reads its settings once

from brax.envs.base import State  # noqa: E402

from hgail_envs.base import EpisodeMetrics, GoalEnv  # noqa: E402
from hgail_envs.checking import check_task  # noqa: E402
from hgail_envs.registry import TASKS, accepted_options, find_class, make, register_gymnasium  # noqa: E402

register_gymnasium()

__all__ = ["TASKS", "EpisodeMetrics", "GoalEnv", "State", "accepted_options", "check_task", "find_class", "make"]

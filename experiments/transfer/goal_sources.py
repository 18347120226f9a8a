"""Sources of the target's position in table 4, by name."""

import contextlib
import functools
from collections.abc import Callable

from experiments.localisation.localiser import ABOVE, CALIBRATED
from experiments.transfer.camera_goal import check_rendering, overhead_estimate
from experiments.transfer.conditions import Estimate, NoisyEstimate
from experiments.transfer.robots.base import Robot
from experiments.transfer.tasks import TASKS

EXACT = "exact"
GOAL_SOURCES: dict[str, Callable[[Robot, contextlib.ExitStack], Estimate]] = {
    EXACT: lambda robot, stack: NoisyEstimate(),
    "camera": overhead_estimate,
    "noisy-cameras": functools.partial(overhead_estimate, noise=CALIBRATED),
    "one-camera": functools.partial(overhead_estimate, views=ABOVE),
    "one-noisy-camera": functools.partial(overhead_estimate, views=ABOVE, noise=CALIBRATED),
}
"""Makers of the estimate for a robot; the stack closes its cameras."""


def check_source(source: str, task: str) -> None:
    """Raises a ValueError if cameras cannot see the task's target, a RuntimeError if MuJoCo cannot render."""
    if source == EXACT:
        return
    seen = [name for name, each in TASKS.items() if each.seen_by_cameras]
    if task not in seen:
        raise ValueError(f"cameras cannot tell the target of {task!r}; they can of {', '.join(seen)}")
    check_rendering()


def stage(source: str) -> str:
    """Returns the entry of a goal source in table 4's column `stage`.

    >>> stage("camera")
    'camera goal'
    """
    return f"{source} goal"

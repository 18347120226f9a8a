"""Where table 4 takes the target's position from, by name."""

import contextlib
import functools
from collections.abc import Callable

from experiments.localisation.localiser import ABOVE, CALIBRATED
from experiments.transfer.camera_goal import overhead_estimate
from experiments.transfer.conditions import Estimate, NoisyEstimate
from experiments.transfer.robots.base import Robot

EXACT = "exact"
GOAL_SOURCES: dict[str, Callable[[Robot, contextlib.ExitStack], Estimate]] = {
    EXACT: lambda robot, stack: NoisyEstimate(),
    "camera": overhead_estimate,
    "noisy-cameras": functools.partial(overhead_estimate, noise=CALIBRATED),
    "one-camera": functools.partial(overhead_estimate, views=ABOVE),
    "one-noisy-camera": functools.partial(overhead_estimate, views=ABOVE, noise=CALIBRATED),
}
"""Each makes the estimate for a robot, and leaves the stack to close it."""


def stage(source: str) -> str:
    """Returns what the column `stage` of table 4 says of a goal source.

    >>> stage("camera")
    'camera goal'
    """
    return f"{source} goal"

"""What table 4 measures on other robots."""

import contextlib
import functools
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from envs.fetch.arm import CONTROL_PERIOD
from experiments.localisation.localiser import ABOVE, CALIBRATED
from experiments.transfer.camera_goal import overhead_estimate
from experiments.transfer.conditions import Conditions, Estimate, NoisyEstimate
from experiments.transfer.measurement import Point
from experiments.transfer.robots import ROBOTS, make_robot
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
"""Where table 4 takes the target's position from: makes the estimate for a robot, and leaves the stack to close it."""


def stage(source: str) -> str:
    """Returns what the column `stage` of table 4 says of a goal source.

    >>> stage("camera")
    'camera goal'
    """
    return f"{source} goal"


def table(sources: Iterable[str], stack: contextlib.ExitStack) -> Iterator[Point]:
    """Yields the rows of table 4: each robot and task with each of these `GOAL_SOURCES`.

    With the exact goal a robot has a row for each of its variants, else one. `stack` must stay open until the rows are
    measured.
    """
    for source in sources:
        for to, robot_class in ROBOTS.items():
            for task in TASKS:
                for options in robot_class.variants(task) if source == EXACT else [{}]:
                    robot = make_robot(to, task, **options)
                    conditions = Conditions(GOAL_SOURCES[source](robot, stack))
                    yield Point(to, task, conditions, options, _table_labels(robot, source))


def _table_labels(robot: Robot, source: str) -> dict[str, Any]:
    task = TASKS[robot.task]
    return {
        "stage": stage(source),
        "hand_at_start": "closed" if robot.starts_closed else "open",
        "milliseconds_per_action": round(1000 * CONTROL_PERIOD * robot.slowdown),
        "paper_success": task.paper_success,
        "paper_distance_l1": task.paper_distance_l1,
    }

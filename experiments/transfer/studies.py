"""What is measured on other robots: the rows of table 4, and the points of the robustness curves."""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from envs.fetch.arm import CONTROL_PERIOD
from experiments.transfer.camera_goal import overhead_estimate
from experiments.transfer.disturbances import DISTURBANCES
from experiments.transfer.episode import Conditions, Estimate, NoisyEstimate
from experiments.transfer.measurement import Point
from experiments.transfer.robots import ROBOTS, make_robot
from experiments.transfer.robots.base import Robot
from experiments.transfer.tasks import TASKS

EXACT = "exact"
GOAL_SOURCES: dict[str, Callable[[Robot, contextlib.ExitStack], Estimate]] = {
    EXACT: lambda robot, stack: NoisyEstimate(),
    "camera": overhead_estimate,
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


def sweep() -> Iterator[Point]:
    """Yields the points of the robustness curves, each curve's in order: robots' own options, then disturbances."""
    for to, robot_class in ROBOTS.items():
        for curve in robot_class.curves:
            for value in curve.values:
                labels = {"quantity": f"{curve.quantity}, {curve.line}", "value": value}
                yield Point(to, curve.task, options={**curve.fixed, curve.option: value}, labels=labels)
    for to in ROBOTS:
        for task in TASKS:
            for quantity, disturbance in DISTURBANCES.items():
                for value in disturbance.values:
                    labels = {"quantity": quantity, "value": value}
                    yield Point(to, task, disturbance.conditions(value), labels=labels)


def sweep_axes() -> dict[str, str]:
    """Returns the label of the x axis for each quantity that `sweep` varies."""
    disturbances = {quantity: disturbance.axis for quantity, disturbance in DISTURBANCES.items()}
    return disturbances | {curve.quantity: curve.axis for robot in ROBOTS.values() for curve in robot.curves}


def _table_labels(robot: Robot, source: str) -> dict[str, Any]:
    task = TASKS[robot.task]
    return {
        "stage": stage(source),
        "hand_at_start": "closed" if robot.starts_closed else "open",
        "milliseconds_per_action": round(1000 * CONTROL_PERIOD * robot.slowdown),
        "paper_success": task.paper_success,
        "paper_distance_l1": task.paper_distance_l1,
    }

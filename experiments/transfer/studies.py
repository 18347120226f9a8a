"""What table 4 measures on other robots."""

from collections.abc import Iterable, Iterator
from typing import Any

from envs.fetch.arm import CONTROL_PERIOD
from experiments.transfer.goal_sources import EXACT, stage
from experiments.transfer.measurement import Point
from experiments.transfer.policies import Policies
from experiments.transfer.robots import ROBOTS, make_robot
from experiments.transfer.robots.base import Robot
from experiments.transfer.tasks import TASKS


def table(sources: Iterable[str], policies: Policies) -> Iterator[Point]:
    """Yields the rows of table 4: each robot, task and policy with each of these `GOAL_SOURCES`.

    With the exact goal a robot has a row for each of its variants, else one. Tasks whose target cameras cannot see have
    rows with the exact goal alone.
    """
    for source in sources:
        for to, robot_class in ROBOTS.items():
            for name, task in TASKS.items():
                if name not in robot_class.tasks or not (source == EXACT or task.seen_by_cameras):
                    continue
                for options in robot_class.variants(name) if source == EXACT else [{}]:
                    for label, files in policies.items():
                        if name in files:
                            labels = _table_labels(make_robot(to, name, **options), source) | {"policy": label}
                            yield Point(
                                to, name, tuple(files[name]), options=options, goal_source=source, labels=labels
                            )


def _table_labels(robot: Robot, source: str) -> dict[str, Any]:
    task = TASKS[robot.task]
    return {
        "stage": stage(source),
        "hand_at_start": "closed" if robot.starts_closed else "open",
        "milliseconds_per_action": round(1000 * CONTROL_PERIOD * robot.slowdown),
        "paper_success": task.paper_success,
        "paper_distance_l1": task.paper_distance_l1,
    }

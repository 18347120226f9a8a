"""Rows of table 4, on other robots."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from experiments.transfer.conditions import TASKS
from experiments.transfer.goal_sources import EXACT, stage
from experiments.transfer.measurement import Point
from experiments.transfer.policies import Policies, load
from experiments.transfer.robots import ROBOTS, make_robot
from experiments.transfer.robots.base import Robot
from hgail_envs.fetch.arm import CONTROL_PERIOD
from hgail_envs.fetch.grasp import CUBES


def table(sources: Iterable[str], robots: Sequence[str], tasks: Sequence[str], policies: Policies) -> Iterator[Point]:
    """Yields the rows of table 4: each of these `ROBOTS`, `TASKS` and policies with each of these `GOAL_SOURCES`.

    With the exact goal a robot has a row for each of its variants, else one. Tasks whose target is hidden from cameras
    have rows with the exact goal alone.
    """
    for source in sources:
        for to, task in parts(source, robots, tasks):
            for options in ROBOTS[to].variants(task) if source == EXACT else [{}]:
                for label, files in policies.items():
                    if task in files:
                        labels = _table_labels(make_robot(to, task, **options), source)
                        labels |= {"policy": label, "cube": _cube(files[task][0], task)}
                        yield Point(to, task, tuple(files[task]), options=options, goal_source=source, labels=labels)


def parts(source: str, robots: Iterable[str], tasks: Iterable[str]) -> list[tuple[str, str]]:
    """Returns the robots and tasks that have rows of a goal source in table 4."""
    return [
        (to, task)
        for to, task in itertools.product(robots, tasks)
        if task in ROBOTS[to].tasks and task in TASKS and (source == EXACT or TASKS[task].seen_by_cameras)
    ]


def _cube(policy: Path, task: str) -> str | None:
    """Returns how a policy of grasp observes the cube, a name in `CUBES`; None of another task."""
    return load(policy, task).task_options.get("cube", CUBES[0]) if task == "grasp" else None


def _table_labels(robot: Robot, source: str) -> dict[str, Any]:
    task = TASKS[robot.task]
    return {
        "stage": stage(source),
        "hand_at_start": "closed" if robot.starts_closed else "open",
        "milliseconds_per_action": round(1000 * CONTROL_PERIOD * robot.slowdown),
        "paper_success": task.paper_success,
        "paper_distance_l1": task.paper_distance_l1,
    }

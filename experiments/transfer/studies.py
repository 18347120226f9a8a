"""Measures the rows of table 4, and sweeps of success over quantities.

Sweeps are of other robots in several processes, and of this project's Fetch in one program.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.transfer.conditions import TASKS
from experiments.transfer.goal_sources import EXACT, stage
from experiments.transfer.measurement import Point, measured
from experiments.transfer.parallel_fetch import NAME, ParallelFetch
from experiments.transfer.policies import Policies, load
from experiments.transfer.quantities import QUANTITIES
from experiments.transfer.robots import ROBOTS, make_robot
from experiments.transfer.robots.base import Robot
from hgail_envs.tasks.base import CONTROL_PERIOD
from hgail_envs.tasks.grasp import CUBES
from hgail_jax.io.policy import load_policy

FETCH = "fetch"
"""Name of this project's Fetch on the command line."""


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


def robot_name(to: str) -> str:
    """Returns the name in rows of a robot of `ROBOTS` or of `FETCH`."""
    return NAME if to == FETCH else ROBOTS[to].name


def measured_pairs(policies: Policies, robots: Sequence[str], tasks: Sequence[str]) -> list[tuple[str, str]]:
    """Returns robot and task of all curves: the tasks that a robot can do and a policy was trained for."""
    return [
        (to, task)
        for to, task in itertools.product(robots, tasks)
        if (to == FETCH or task in ROBOTS[to].tasks) and any(task in files for files in policies.values())
    ]


def robot_points(policies: Policies, robots: Sequence[str], tasks: Sequence[str]) -> Iterator[Point]:
    """Yields the points on other robots, each curve's in order: robots' own options, then `QUANTITIES`."""
    for to, (label, files) in itertools.product(robots, policies.items()):
        for curve in ROBOTS[to].curves:
            for value in curve.values if curve.task in tasks and curve.task in files else ():
                labels = {"policy": label, "quantity": f"{curve.quantity}, {curve.line}", "value": value}
                options = {**curve.fixed, curve.option: value}
                yield Point(to, curve.task, tuple(files[curve.task]), options=options, labels=labels)
        for task in tasks:
            for name, quantity in _quantities(task) if task in files and task in ROBOTS[to].tasks else ():
                affects = quantity.conditions and name not in ROBOTS[to].unaffected_by
                for value in quantity.values if affects else ():
                    conditions, labels = quantity.conditions(value), _labels(label, name, value)
                    yield Point(to, task, tuple(files[task]), conditions, labels=labels)


def fetch_points(policies: Policies, tasks: Sequence[str]) -> list[tuple[str, str, str, float, Mapping]]:
    """Returns policy, task, quantity, value and sizes of the points on this project's Fetch, each curve's in order."""
    return [
        (label, task, name, value, quantity.sizes(value))
        for label, files in policies.items()
        for task in tasks
        if task in files
        for name, quantity in _quantities(task)
        if quantity.sizes
        for value in quantity.values
    ]


def fetch_rows(policies: Policies, tasks: Sequence[str], episodes: int, seed: int) -> Iterator[dict[str, Any]]:
    """Yields the rows of this project's Fetch as they are measured."""
    for (label, task), points in itertools.groupby(fetch_points(policies, tasks), lambda point: point[:2]):
        files = policies[label][task]
        fetch = ParallelFetch(task, [load_policy(path) for path in files], episodes, seed)
        for _, _, name, value, sizes in points:
            outcomes = fetch.outcomes(**sizes)
            columns = {"robot": NAME, "task": task} | _labels(label, name, value)
            yield columns | measured(outcomes, len(files), episodes)


def axes() -> dict[str, str]:
    """Returns the label of the x axis for each quantity that is varied."""
    axes = {name: quantity.axis for name, quantity in QUANTITIES.items()}
    return axes | {curve.quantity: curve.axis for robot in ROBOTS.values() for curve in robot.curves}


def _labels(policy: str, quantity: str, value: float) -> dict[str, Any]:
    return {"policy": policy, "quantity": quantity, "value": value}


def _quantities(task: str) -> list[tuple[str, Any]]:
    """Returns the quantities that affect a task, with their names."""
    return [(name, each) for name, each in QUANTITIES.items() if task in each.tasks]

"""Measures success against disturbances: other robots in several processes, this package's Fetch in one program."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from experiments.transfer.disturbances import DISTURBANCES
from experiments.transfer.measurement import Point, measured
from experiments.transfer.parallel_fetch import NAME, ParallelFetch
from experiments.transfer.policies import Policies
from experiments.transfer.robots import ROBOTS
from hgail_jax.io.policy import load_policy

FETCH = "fetch"
"""What the command line calls this package's Fetch."""


def robot_name(to: str) -> str:
    """Returns what rows call a robot of `ROBOTS`, or this package's Fetch, given what the command line calls it."""
    return NAME if to == FETCH else ROBOTS[to].name


def measured_pairs(policies: Policies, robots: Sequence[str], tasks: Sequence[str]) -> list[tuple[str, str]]:
    """Returns robot and task of all curves: the tasks that a robot can do and that a policy is there for."""
    return [
        (to, task)
        for to, task in itertools.product(robots, tasks)
        if (to == FETCH or task in ROBOTS[to].tasks) and any(task in files for files in policies.values())
    ]


def robot_points(policies: Policies, robots: Sequence[str], tasks: Sequence[str]) -> Iterator[Point]:
    """Yields the points on other robots, each curve's in order: robots' own options, then disturbances."""
    for to, (label, files) in itertools.product(robots, policies.items()):
        for curve in ROBOTS[to].curves:
            for value in curve.values if curve.task in tasks and curve.task in files else ():
                labels = {"policy": label, "quantity": f"{curve.quantity}, {curve.line}", "value": value}
                options = {**curve.fixed, curve.option: value}
                yield Point(to, curve.task, tuple(files[curve.task]), options=options, labels=labels)
        for task in tasks:
            for quantity, disturbance in _disturbances(task) if task in files and task in ROBOTS[to].tasks else ():
                affects = disturbance.conditions and quantity not in ROBOTS[to].unaffected_by
                for value in disturbance.values if affects else ():
                    conditions, labels = disturbance.conditions(value), _labels(label, quantity, value)
                    yield Point(to, task, tuple(files[task]), conditions, labels=labels)


def fetch_points(policies: Policies, tasks: Sequence[str]) -> list[tuple[str, str, str, float, Mapping]]:
    """Returns policy, task, quantity, value and sizes of the points on this package's Fetch, each curve's in order."""
    return [
        (label, task, quantity, value, disturbance.sizes(value))
        for label, files in policies.items()
        for task in tasks
        if task in files
        for quantity, disturbance in _disturbances(task)
        if disturbance.sizes
        for value in disturbance.values
    ]


def fetch_rows(policies: Policies, tasks: Sequence[str], episodes: int, seed: int) -> Iterator[dict[str, Any]]:
    """Yields the rows of this package's Fetch as they are measured."""
    for (label, task), points in itertools.groupby(fetch_points(policies, tasks), lambda point: point[:2]):
        files = policies[label][task]
        fetch = ParallelFetch(task, [load_policy(path) for path in files], episodes, seed)
        for _, _, quantity, value, sizes in points:
            outcomes = fetch.outcomes(**sizes)
            columns = {"robot": NAME, "task": task} | _labels(label, quantity, value)
            yield columns | measured(outcomes, len(files), episodes)


def axes() -> dict[str, str]:
    """Returns the label of the x axis for each quantity that is varied."""
    disturbances = {quantity: disturbance.axis for quantity, disturbance in DISTURBANCES.items()}
    return disturbances | {curve.quantity: curve.axis for robot in ROBOTS.values() for curve in robot.curves}


def _labels(policy: str, quantity: str, value: float) -> dict[str, Any]:
    return {"policy": policy, "quantity": quantity, "value": value}


def _disturbances(task: str) -> list[tuple[str, Any]]:
    """Returns the disturbances of a task, by name."""
    return [(name, each) for name, each in DISTURBANCES.items() if task in each.tasks]

"""Measures success against disturbances: other robots in several processes, this package's Fetch in one program."""

import concurrent.futures
import itertools
import multiprocessing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.transfer.disturbances import DISTURBANCES
from experiments.transfer.measurement import Measured, Point, measured, policy_paths
from experiments.transfer.parallel_fetch import NAME, ParallelFetch
from experiments.transfer.robots import ROBOTS
from hgail_jax.io.policy import load_policy

PLAIN = "plain"
"""Label of the policies that come with the repository."""
FETCH = "fetch"
"""What the command line calls this package's Fetch."""
Policies = Mapping[str, Mapping[str, Sequence[Path]]]
"""Files of policies by label and then by task."""


def find_policies(more: Sequence[str], tasks: Sequence[str]) -> Policies:
    """Returns the plain policies and others.

    Args:
      more: each `label=path`, of a policy's file or of a folder of them; a label may come several times.
      tasks: that there must be plain policies for.

    Raises:
      ValueError: one is not of this form, or there is no policy.
      OSError: a file cannot be read.

    """
    found: dict[str, dict[str, list[Path]]] = {PLAIN: {task: list(policy_paths(task)) for task in tasks}}
    for entry in more:
        label, separator, path = entry.partition("=")
        if not (label and separator and path) or label == PLAIN:
            raise ValueError(f"policies {entry!r} is not label=path, with another label than {PLAIN!r}")
        files = sorted(Path(path).glob("*.npz")) if Path(path).is_dir() else [Path(path)]
        if not files:
            raise ValueError(f"there is no policy in {path}")
        for file in files:
            found.setdefault(label, {}).setdefault(load_policy(file).task, []).append(file)
    return found


def robot_points(policies: Policies, robots: Sequence[str], tasks: Sequence[str]) -> Iterator[Point]:
    """Yields the points on other robots, each curve's in order: robots' own options, then disturbances."""
    for to, (label, files) in itertools.product(robots, policies.items()):
        for curve in ROBOTS[to].curves:
            for value in curve.values if curve.task in tasks and curve.task in files else ():
                labels = {"policy": label, "quantity": f"{curve.quantity}, {curve.line}", "value": value}
                options = {**curve.fixed, curve.option: value}
                yield Point(to, curve.task, options=options, labels=labels, policies=tuple(files[curve.task]))
        for task in tasks:
            for quantity, disturbance in _disturbances(task) if task in files and task in ROBOTS[to].tasks else ():
                for value in disturbance.values if disturbance.conditions else ():
                    conditions, labels = disturbance.conditions(value), _labels(label, quantity, value)
                    yield Point(to, task, conditions, labels=labels, policies=tuple(files[task]))


def fetch_rows(policies: Policies, tasks: Sequence[str], episodes: int, seed: int) -> Iterator[dict[str, Any]]:
    """Yields the rows of this package's Fetch as they are measured."""
    for label, files in policies.items():
        for task in tasks:
            if task not in files:
                continue
            fetch = ParallelFetch(task, [load_policy(path) for path in files[task]], episodes, seed)
            for quantity, disturbance in _disturbances(task):
                for value in disturbance.values if disturbance.sizes else ():
                    outcomes = fetch.outcomes(**disturbance.sizes(value))
                    columns = {"robot": NAME, "task": task} | _labels(label, quantity, value)
                    yield columns | measured(outcomes, len(files[task]), episodes)


def measure_points(points: Sequence[Point], episodes: int, seed: int, workers: int) -> Iterator[Measured]:
    """Yields what points measure, in order, in so many processes; points that measure the same do so once."""
    if workers == 1:
        yield from map(_measure, points, itertools.repeat(episodes), itertools.repeat(seed))
        return
    context = multiprocessing.get_context("spawn")  # JAX has threads, which a fork would lose
    with concurrent.futures.ProcessPoolExecutor(workers, context) as pool:
        yield from pool.map(_measure, points, itertools.repeat(episodes), itertools.repeat(seed))


def axes() -> dict[str, str]:
    """Returns the label of the x axis for each quantity that is varied."""
    disturbances = {quantity: disturbance.axis for quantity, disturbance in DISTURBANCES.items()}
    return disturbances | {curve.quantity: curve.axis for robot in ROBOTS.values() for curve in robot.curves}


def _measure(point: Point, episodes: int, seed: int) -> Measured:
    return point.measure(episodes, seed, lambda: None)


def _labels(policy: str, quantity: str, value: float) -> dict[str, Any]:
    return {"policy": policy, "quantity": quantity, "value": value}


def _disturbances(task: str) -> list[tuple[str, Any]]:
    """Returns the disturbances of a task, by name."""
    return [(name, each) for name, each in DISTURBANCES.items() if task != "reach" or not each.of_object]

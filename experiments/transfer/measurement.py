"""Measures success rates and final distances of policies on a robot."""

import concurrent.futures
import contextlib
import dataclasses
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy import stats

from experiments.transfer.conditions import Conditions, MeanAction
from experiments.transfer.episode import run_episodes
from experiments.transfer.goal_sources import GOAL_SOURCES, TargetNotSeenError
from experiments.transfer.policies import load
from experiments.transfer.robots import ROBOTS, make_robot
from experiments.transfer.robots.base import Robot
from hgail_envs import EpisodeMetrics
from hgail_jax.terminal import progress_bar

Measured = dict[str, float | None]
"""Columns of a row that are measured."""
_FIELDS = [field.name for field in dataclasses.fields(EpisodeMetrics)]
_PART = 20  # episodes of a point that a process runs at a time


def measure(
    robot: Robot,
    policies: Sequence[MeanAction],
    indices: Sequence[int],
    seed: int,
    conditions: Conditions,
    on_episode: Callable[[], object] = lambda: None,
) -> EpisodeMetrics:
    """Runs episodes of several policies on a robot.

    Args:
      robot: to act.
      policies: to take turns.
      indices: of the episodes.
      seed: of the episodes' starts and of the estimates.
      conditions: of the episodes.
      on_episode: called after each episode.

    Returns:
      Metrics of the episodes whose target was seen, leaves `[at most the number of indices]`.
    """
    outcomes = []
    for index in indices:
        with contextlib.suppress(TargetNotSeenError):
            outcomes += run_episodes(robot, policies, [index], seed, conditions)
        on_episode()
    columns: dict[str, Any] = {name: np.array([getattr(outcome, name) for outcome in outcomes]) for name in _FIELDS}
    return EpisodeMetrics(**columns)


def measured(outcomes: EpisodeMetrics, policies: int, episodes: int) -> Measured:
    """Returns the measured columns of a row.

    Args:
      outcomes: leaves `[n]`; of the other `episodes - n` no target was seen: failures without a distance.
      policies: number of them that took turns.
      episodes: number of all episodes.

    Returns:
      Rates, success with its 95 % Wilson interval, and mean distances in metres, None if no target was seen.
    """
    success, achieved = np.asarray(outcomes.success), np.asarray(outcomes.achieved)
    interval = stats.binomtest(int(success.sum()), episodes).proportion_ci(method="wilson")
    return {
        "policies": min(policies, episodes),
        "episodes": episodes,
        "success_rate": float(success.sum() / episodes),
        "success_low": round(interval.low, 4),
        "success_high": round(interval.high, 4),
        "achieved_rate": float(achieved.sum() / episodes),
        "distance_l1": _mean(np.asarray(outcomes.distance_l1)),
        "distance_l2": _mean(np.asarray(outcomes.distance_l2)),
        "not_seen": (episodes - success.size) / episodes,
    }


@dataclasses.dataclass(frozen=True)
class Point:
    """Row of a table, or point of a curve, to be measured."""

    to: str
    """Name of the robot in `ROBOTS`."""
    task: str
    policies: tuple[Path, ...]
    """Files of the policies, or `SCRIPT`."""
    conditions: Conditions = Conditions()  # noqa: RUF009  (frozen)
    goal_source: str | None = None
    """Name in `GOAL_SOURCES` of the target's estimate; None is that of the conditions."""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """The robot's options."""
    labels: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Further columns of the row, besides robot, task and those measured."""

    def measure(self, indices: Sequence[int], seed: int) -> EpisodeMetrics:
        """Runs some of its episodes; see `measure`."""
        robot = make_robot(self.to, self.task, **self.options)
        policies, conditions = [load(path, self.task) for path in self.policies], self.conditions
        if self.goal_source:
            conditions = dataclasses.replace(conditions, estimate=GOAL_SOURCES[self.goal_source](robot))
        return measure(robot, policies, indices, seed, conditions)

    def row(self, measured: Measured) -> dict[str, Any]:
        """Returns the row, given the columns that were measured."""
        return {"robot": ROBOTS[self.to].name, "task": self.task} | dict(self.labels) | measured

    def key(self) -> tuple:
        """Returns a key that is equal for points that differ in labels alone, and so measure the same."""
        options = tuple(sorted(self.options.items()))
        return self.to, self.task, self.policies, self.conditions, self.goal_source, options


def measure_rows(points: Sequence[Point], episodes: int, seed: int, workers: int) -> Iterator[dict[str, Any]]:
    """Yields the rows of points, in order, with a progress bar; points with equal keys are measured once.

    Args:
      points: to measure.
      episodes: for each of them.
      seed: of the episodes.
      workers: processes.
    """
    parts = [range(start, min(start + _PART, episodes)) for start in range(0, episodes, _PART)]
    work = [(point, part, seed) for point in {point.key(): point for point in points}.values() for part in parts]
    done: dict[tuple, Measured] = {}
    with _mapping(workers) as run, progress_bar(total=len(work) * episodes // len(parts), unit="episode") as progress:
        outcomes = run(_measure, work)
        for point in points:
            if point.key() not in done:
                measured_parts = []
                for part in parts:
                    measured_parts.append(next(outcomes))
                    progress.update(len(part))
                outcome = jax.tree.map(lambda *leaves: np.concatenate(leaves), *measured_parts)
                done[point.key()] = measured(outcome, len(point.policies), episodes)
            yield point.row(done[point.key()])


@contextlib.contextmanager
def _mapping(workers: int) -> Iterator[Callable[..., Iterator[Any]]]:
    """Yields a `map` over this many processes; with 1 it runs in this one."""
    if workers == 1:
        yield map
        return
    context = multiprocessing.get_context("spawn")  # JAX has threads, which a fork would lose
    pool = concurrent.futures.ProcessPoolExecutor(workers, context, initializer=_keep_to_the_cpu)
    try:
        yield pool.map
    finally:
        pool.shutdown(cancel_futures=True)


def _keep_to_the_cpu() -> None:
    """Keeps JAX off the GPU, whose memory many processes would fill."""
    jax.config.update("jax_platforms", "cpu")


def _measure(work: tuple[Point, Sequence[int], int]) -> EpisodeMetrics:
    point, indices, seed = work
    return point.measure(indices, seed)


def _mean(distances: np.ndarray) -> float | None:
    return round(float(np.mean(distances)), 5) if distances.size else None

"""Measures how often policies succeed on a robot, and how far from the target they end."""

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from envs import EpisodeMetrics
from experiments.localisation.localiser import TargetNotSeenError
from experiments.transfer.conditions import Conditions
from experiments.transfer.episode import run_episodes
from experiments.transfer.paths import RESULTS
from experiments.transfer.robots import ROBOTS, make_robot
from experiments.transfer.robots.base import Robot
from hgail_jax.io.policy import MeanPolicy, load_policy

Measured = dict[str, float | None]
"""Columns of a row that are measured."""
_FIELDS = dataclasses.fields(EpisodeMetrics)


def policy_paths(task: str) -> list[Path]:
    """Returns the files of the policies that come with the repository for a task.

    Raises:
      ValueError: there are none.

    """
    paths = sorted((RESULTS / "runs" / f"{task}-hgail" / "policies").glob("*.npz"))
    if not paths:
        raise ValueError(f"no policy of {task!r} comes with the repository; give one by --policy")
    return paths


def load_policies(task: str, path: Path | None = None) -> list[MeanPolicy]:
    """Loads one policy, or all that come with the repository for a task.

    Raises:
      ValueError: a file is not a policy of the task.
      OSError: a file cannot be read.

    """
    policies = [load_policy(path) for path in ([path] if path else policy_paths(task))]
    for policy in policies:
        if policy.task != task:
            raise ValueError(f"the policy is for {policy.task!r}, not for {task!r}")
    return policies


def measure(
    robot: Robot,
    policies: Sequence[MeanPolicy],
    episodes: int,
    seed: int,
    conditions: Conditions,
    on_episode: Callable[[], object],
) -> Measured:
    """Runs episodes, the policies taking turns.

    An episode whose target no camera sees has failed, and has no distance.

    Args:
      robot: what acts.
      policies: what decides.
      episodes: how many.
      seed: of the episodes' starts and of the estimates.
      conditions: what disturbs the episodes.
      on_episode: called after each episode.

    Returns:
      Rates, that of success with its 95 % Wilson interval, and mean distances in metres, None where there is none.

    """
    outcomes = []
    for index in range(episodes):
        with contextlib.suppress(TargetNotSeenError):
            outcomes += run_episodes(robot, policies, [index], seed, conditions)
        on_episode()
    columns: dict[str, Any] = {
        field.name: np.array([getattr(outcome, field.name) for outcome in outcomes]) for field in _FIELDS
    }
    return measured(EpisodeMetrics(**columns), len(policies), episodes)


def measured(outcomes: EpisodeMetrics, policies: int, episodes: int) -> Measured:
    """Returns what `measure` does, of outcomes `[n]`; of the other episodes, up to `episodes`, no target was seen."""
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
    """A row of a table, or a point of a curve, that is to be measured."""

    to: str
    """Name of the robot in `ROBOTS`."""
    task: str
    conditions: Conditions = Conditions()  # noqa: RUF009  (frozen)
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """The robot's options."""
    labels: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Columns of the row besides robot, task and what is measured."""
    policies: tuple[Path, ...] = ()
    """Files of the policies; by default all that come with the repository for the task."""

    def measure(self, episodes: int, seed: int, on_episode: Callable[[], object]) -> Measured:
        """Measures the point; see `measure`."""
        robot = make_robot(self.to, self.task, **self.options)
        policies = [policy for path in self.policies or [None] for policy in load_policies(self.task, path)]
        return measure(robot, policies, episodes, seed, self.conditions, on_episode)

    def row(self, measured: Measured) -> dict[str, Any]:
        """Returns the row, given the columns that were measured."""
        return {"robot": ROBOTS[self.to].name, "task": self.task} | dict(self.labels) | measured

    def key(self) -> tuple:
        """Returns what is equal for points that differ in their labels alone, and so measure the same."""
        return self.to, self.task, self.conditions, tuple(sorted(self.options.items())), self.policies


def _mean(distances: np.ndarray) -> float | None:
    return round(float(np.mean(distances)), 5) if distances.size else None

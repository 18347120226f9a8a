"""Measures how often policies succeed on a robot, and how far from the target they end."""

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from experiments.localisation.localiser import TargetNotSeenError
from experiments.transfer.episode import Conditions, run_episodes
from experiments.transfer.paths import RESULTS
from experiments.transfer.robots import ROBOTS, make_robot
from experiments.transfer.robots.base import Robot
from hgail_jax.io.policy import MeanPolicy, load_policy

Measured = dict[str, float | None]
"""Columns of a row that are measured."""


def load_policies(task: str, path: Path | None = None) -> list[MeanPolicy]:
    """Loads one policy, or all that come with the repository for a task.

    Raises:
      ValueError: a file is not a policy of the task.
      OSError: a file cannot be read.

    """
    paths = [path] if path else sorted((RESULTS / "runs" / f"{task}-hgail" / "policies").glob("*.npz"))
    if not paths:
        raise ValueError(f"no policy of {task!r} comes with the repository; give one by --policy")
    policies = [load_policy(path) for path in paths]
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
    successes = int(sum(outcome.success for outcome in outcomes))
    interval = stats.binomtest(successes, episodes).proportion_ci(method="wilson")
    return {
        "policies": min(len(policies), episodes),
        "episodes": episodes,
        "success_rate": successes / episodes,
        "success_low": round(interval.low, 4),
        "success_high": round(interval.high, 4),
        "achieved_rate": float(sum(outcome.achieved for outcome in outcomes) / episodes),
        "distance_l1": _mean([outcome.distance_l1 for outcome in outcomes]),
        "distance_l2": _mean([outcome.distance_l2 for outcome in outcomes]),
        "not_seen": (episodes - len(outcomes)) / episodes,
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

    def measure(self, episodes: int, seed: int, on_episode: Callable[[], object]) -> Measured:
        """Measures the point with all policies that come with the repository for its task; see `measure`."""
        robot = make_robot(self.to, self.task, **self.options)
        return measure(robot, load_policies(self.task), episodes, seed, self.conditions, on_episode)

    def row(self, measured: Measured) -> dict[str, Any]:
        """Returns the row, given the columns that were measured."""
        return {"robot": ROBOTS[self.to].name, "task": self.task} | dict(self.labels) | measured

    def key(self) -> tuple:
        """Returns what is equal for points that differ in their labels alone, and so measure the same."""
        return self.to, self.task, self.conditions, tuple(sorted(self.options.items()))


def _mean(distances: list) -> float | None:
    return round(float(np.mean(distances)), 5) if distances else None

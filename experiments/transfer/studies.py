"""What is measured when policies go to other robots: the rows of table 4, and the points of the robustness curves."""

import contextlib
import dataclasses
import functools
import importlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from envs.fetch.arm import CONTROL_PERIOD
from experiments.localisation.localiser import TargetNotSeenError
from experiments.transfer.camera_goal import from_cameras
from experiments.transfer.episode import Conditions, Estimate, Robot, exact, mistaken, run_episodes
from hgail_jax.io.policy import MeanPolicy, load_policy

RESULTS = Path(__file__).resolve().parent / "results"
TASKS = ("reach", "grasp")
ROBOTS = {"gymnasium": ("reference", "Reference", "compare"), "ur5e": ("ur5e", "UR5e", "ur5e")}
"""Module and class of each robot, and the extra of this package that its dependencies come with."""
NAMES = {
    "gymnasium": "Fetch, Gymnasium-Robotics on C MuJoCo",
    "ur5e": "UR5e with Robotiq 2F-85, C MuJoCo",
}
EXACT = "exact goal"
STAGES: dict[str, Callable[[Robot, contextlib.ExitStack], Estimate]] = {
    EXACT: lambda robot, stack: exact,
    "camera goal": from_cameras,
}
"""How the target is localised at each stage, given the robot whose scene it is in, and what closes things later."""

_PAPER = {"reach": (0.95, 0.01), "grasp": (0.93, 0.02)}  # success and L1 in metres, on the real UR5


@functools.cache
def make_robot(to: str, task: str, **options: Any) -> Robot:
    """Makes a robot of `ROBOTS` for a task, once.

    Raises:
      ValueError: a package that it needs is not installed.

    """
    module, name, extra = ROBOTS[to]
    try:
        return getattr(importlib.import_module(module), name)(task, **options)
    except ModuleNotFoundError as error:
        raise ValueError(f'{to} needs the package {error.name}; pip install -e ".[{extra}]"') from error


def load_policies(task: str, path: Path | None = None) -> list[MeanPolicy]:
    """Loads one policy, or all that come with the repository for a task.

    Raises:
      ValueError: a file is not a policy of the task.
      OSError: a file cannot be read.

    """
    paths = [path] if path else sorted((RESULTS / f"{task}-hgail" / "policies").glob("*.npz"))
    policies = [load_policy(path) for path in paths]
    for policy in policies:
        if policy.task != task:
            raise ValueError(f"the policy is for {policy.task!r}, not for {task!r}")
    return policies


def measure(
    robot: Robot, policies: Sequence[MeanPolicy], episodes: int, seed: int, conditions: Conditions, tick: Callable
) -> dict[str, float | None]:
    """Runs episodes, the policies taking turns; returns rates with their 95 % interval by Wilson, and mean distances.

    An episode whose target is not seen has failed, without a distance. `tick` is called after each episode.
    """
    outcomes = []
    for index in range(episodes):
        with contextlib.suppress(TargetNotSeenError):
            outcomes += run_episodes(robot, policies, [index], seed, conditions)
        tick()
    succeeded = int(sum(outcome.success for outcome in outcomes))
    interval = stats.binomtest(succeeded, episodes).proportion_ci(method="wilson")
    return {
        "policies": min(len(policies), episodes),
        "episodes": episodes,
        "success_rate": succeeded / episodes,
        "success_low": round(interval.low, 4),
        "success_high": round(interval.high, 4),
        "achieved_rate": float(sum(outcome.achieved for outcome in outcomes) / episodes),
        "distance_l1": _mean([outcome.distance_l1 for outcome in outcomes]),
        "distance_l2": _mean([outcome.distance_l2 for outcome in outcomes]),
        "not_seen": (episodes - len(outcomes)) / episodes,
    }


@dataclasses.dataclass(frozen=True)
class Point:
    """One row to be measured."""

    to: str
    task: str
    conditions: Conditions = Conditions()  # noqa: RUF009  (frozen)
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Of the robot."""
    labels: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """What the row says besides robot and task."""

    def robot(self) -> Robot:
        """Returns the robot."""
        return make_robot(self.to, self.task, **self.options)

    def measure(self, episodes: int, seed: int, tick: Callable) -> dict[str, float | None]:
        """Measures it, with all policies of the task that come with the repository; see `measure`."""
        return measure(self.robot(), load_policies(self.task), episodes, seed, self.conditions, tick)

    def row(self, measured: dict[str, float | None]) -> dict[str, Any]:
        """Returns its row of a table."""
        return {"robot": NAMES[self.to], "task": self.task} | dict(self.labels) | measured

    def key(self) -> tuple:
        """Returns what points have in common that differ in labels alone."""
        return self.to, self.task, self.conditions, tuple(sorted(self.options.items()))


def table(stages: Iterable[str], stack: contextlib.ExitStack) -> Iterator[Point]:
    """Yields the rows of table 4: each of `STAGES` asked for, each robot and task.

    With the exact goal, the UR5e also has the Fetch's speed and start. `stack` closes what localises, once rows are
    measured.
    """
    for stage in stages:
        for to in ROBOTS:
            for task in TASKS:
                for options in _ways(to, task) if stage == EXACT else [{}]:
                    robot = make_robot(to, task, **options)
                    yield Point(to, task, Conditions(STAGES[stage](robot, stack)), options, _labels(robot, task, stage))


def sweep() -> Iterator[Point]:
    """Yields the points of the curves, those of a quantity in order."""
    for start_closed in (False, True):
        for slowdown in (1, 2, 3, 4):
            options = {"slowdown": slowdown} | ({"start_closed": True} if start_closed else {})
            quantity = f"slowdown, hand {'closed' if start_closed else 'open'}"
            yield Point("ur5e", "grasp", options=options, labels={"quantity": quantity, "value": slowdown})
    for to in ROBOTS:
        for task in TASKS:
            for quantity, values in QUANTITIES.items():
                for value in values:
                    labels = {"quantity": quantity, "value": value}
                    yield Point(to, task, condition(quantity, value), labels=labels)


_OFFSETS = (-0.03, -0.015, 0.0, 0.015, 0.03)  # metres
QUANTITIES: dict[str, tuple[float, ...]] = {
    "noise": (0.0, 0.005, 0.01, 0.02, 0.03, 0.05),  # metres, standard deviation of each coordinate
    "offset x": _OFFSETS,
    "offset y": _OFFSETS,
    "offset z": _OFFSETS,
    "delay": (0, 1, 2, 3),  # steps
    "stride": (0.5, 0.75, 1.0, 1.25, 1.5),
}
"""What the curves vary, and the values."""


def condition(quantity: str, value: float) -> Conditions:
    """Returns the conditions in which one of `QUANTITIES` has a value, and all else is as it was.

    >>> condition("delay", 2).delay
    2
    """
    if value == (1.0 if quantity == "stride" else 0.0):
        return Conditions()
    if quantity == "noise":
        return Conditions(mistaken(noise=value))
    if quantity == "delay":
        return Conditions(delay=int(value))
    if quantity == "stride":
        return Conditions(stride=value)
    return Conditions(mistaken(offset=value * np.eye(3)["xyz".index(quantity[-1])]))


def _mean(distances: list) -> float | None:
    return round(float(np.mean(distances)), 5) if distances else None


def _ways(to: str, task: str) -> list[dict[str, Any]]:
    if to != "ur5e":
        return [{}]
    return [{}, {"slowdown": 1}] + ([{"start_closed": True}] if task == "grasp" else [])


def _labels(robot: Robot, task: str, stage: str) -> dict[str, Any]:
    success, distance = _PAPER[task]
    closed = task == "reach" or getattr(robot, "start_closed", True)
    return {
        "stage": stage,
        "hand_at_start": "closed" if closed else "open",
        "milliseconds_per_action": round(1000 * CONTROL_PERIOD * getattr(robot, "slowdown", 1)),
        "paper_success": success,
        "paper_distance_l1": distance,
    }

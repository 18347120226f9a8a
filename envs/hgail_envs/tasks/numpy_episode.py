"""An episode of a Fetch task in NumPy, for robots and references that JAX does not step."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from hgail_envs.base import EpisodeMetrics
from hgail_envs.registry import find_class
from hgail_envs.tasks.grasp import LEAST_RISE


class Robot(Protocol):
    """Robot or reference that does a Fetch task; positions are metres, `[3]`."""

    task: str
    """Name in `hgail_envs.TASKS`."""

    def features(self) -> np.ndarray:
        """Returns the features of the task's class."""

    def target(self) -> np.ndarray:
        """Returns the target's position."""

    def carried(self) -> np.ndarray:
        """Returns the position that is compared with the target."""

    def reached(self) -> bool:
        """Returns whether that position is near enough to the target."""

    def step(self, action: np.ndarray) -> None:
        """Carries out an action, `[4]`."""


def run_episode(robot: Robot, act: Callable[[], np.ndarray]) -> EpisodeMetrics:
    """Runs an episode from the robot's present state, and the lift test if the task has one.

    `act` returns the next action, `[4]`. Returns the metrics of the last step, as `GoalEnv.outcome` of the task defines
    them, as plain numbers.
    """
    task, start = find_class(robot.task), robot.target()
    for _ in range(task.episode_length):
        action = act()
        robot.step(action)
    position, target = robot.carried(), robot.target()
    if task.lift_test_steps:
        achieved = bool(robot.features()[task.features_layout["hand holds the cube"]])
    else:
        achieved = robot.reached()
    for _ in range(task.lift_test_steps):
        robot.step(np.array([0.0, 0.0, 1.0, action[3]]))  # straight up, the hand as it was: `Grasp.lift_test_action`
    rise = robot.target()[2] - start[2] if task.lift_test_steps else np.inf
    l1 = float(np.abs(position - target).sum())
    return EpisodeMetrics(
        success=float(achieved and rise > LEAST_RISE),
        achieved=float(achieved),
        success_l1=float(l1 <= task.success_threshold),
        distance_l1=l1,
        distance_l2=float(np.linalg.norm(position - target)),
    )

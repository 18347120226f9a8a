"""Observations of a policy on a robot: features and goals with sensor errors, and the history."""

import collections

import numpy as np

from experiments.transfer.conditions import Conditions, MeanAction
from experiments.transfer.robots.base import Robot
from hgail_envs.randomization import Randomization


class Sensors:
    """The errors of an episode's sensors.

    Args:
      rng: source of the errors; exact sensors draw none.
      conditions: with the errors' sizes.

    """

    def __init__(self, rng: np.random.Generator, conditions: Conditions) -> None:
        self._rng, self._conditions = rng, conditions
        self._offset = self._draw(conditions.robot_offset)
        self._noise: np.ndarray | None = None

    def features(self, robot: Robot) -> np.ndarray:
        """Returns the robot's features with errors of the gripper's position.

        The errors enter the position, `0:3`, the displacement in the last action, `3:6`, and, in a task with an object,
        its position relative to the gripper, `6:9`.
        """
        seen, noise = robot.features().copy(), self._draw(self._conditions.robot_noise)
        seen[:3] += self._offset + noise
        seen[3:6] += 0.0 if self._noise is None else noise - self._noise
        if len(seen) > 8:  # 6:9 is the object's position less the gripper's
            seen[6:9] -= self._offset + noise
        self._noise = noise
        return seen

    def goal(self, goal: np.ndarray) -> np.ndarray:
        """Returns a goal, `[3]` or more, with the noise of one step."""
        return goal + np.append(self._draw(self._conditions.goal_noise), np.zeros(len(goal) - 3))

    def _draw(self, deviation: float) -> np.ndarray:
        return deviation * self._rng.standard_normal(3) if deviation else np.zeros(3)


class History:
    """The last actions and the features before each, as in `RandomizedEnv`.

    Args:
      robot: at the start of an episode.
      policy: with the length of the history in its `randomization`, if it has one.
      sensors: of the first features.

    """

    def __init__(self, robot: Robot, policy: MeanAction, sensors: Sensors) -> None:
        count = getattr(policy, "randomization", Randomization()).history
        first = [np.concatenate([np.zeros(4), sensors.features(robot)])] * count if count else []
        self.rows = collections.deque(first, maxlen=count)
        """Newest first, each an action and features."""

    def add(self, action: np.ndarray, seen: np.ndarray) -> None:
        """Adds an action and the features that it answered."""
        self.rows.appendleft(np.concatenate([action, seen]))

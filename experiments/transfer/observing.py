"""Observations of a policy on a robot: features and goals with sensor errors."""

import numpy as np

from experiments.transfer.conditions import Conditions, MeanAction
from experiments.transfer.robots.base import Robot
from hgail_envs import find_class
from hgail_envs.randomization import Randomization


def tracks_cube(policy: MeanAction) -> bool:
    """Returns whether a policy observes the cube at each step; see `hgail_envs.fetch.grasp.Grasp`."""
    return getattr(policy, "task_options", {}).get("cube") == "tracked"


def trained_under(policy: MeanAction) -> Randomization:
    """Returns the randomisation of a policy's training; a script had none."""
    return getattr(policy, "randomization", Randomization())


class Sensors:
    """The sensors of an episode, with their errors.

    Args:
      robot: at the start of the episode.
      policy: with `task_options`, if it has any.
      rng: source of the errors; exact sensors draw none.
      conditions: with the errors' sizes.

    """

    def __init__(self, robot: Robot, policy: MeanAction, rng: np.random.Generator, conditions: Conditions) -> None:
        self._robot, self._rng, self._conditions = robot, rng, conditions
        self._look = conditions.estimate(rng)
        self._tracks = tracks_cube(policy)
        self._target = None if self._tracks else self._look(robot.target())
        self._goal_size = find_class(robot.task).goal_size
        options = getattr(policy, "task_options", {}) | {"cube": "at-start"}  # the sensors add a tracked cube
        self._layout = find_class(robot.task).features_with(**options)
        self._offset = self._draw(conditions.robot_offset)
        self._noise: np.ndarray | None = None

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns features and goal at a step, `[feature_size]` and `[goal_size]`.

        The errors of the gripper enter its position, its velocity, which is the displacement in the last action, and,
        in a task with an object, the object's position relative to the gripper. A tracked cube is the goal, and is seen
        there and in the features with the same error.
        """
        features, noise = self._robot.features().copy(), self._draw(self._conditions.robot_noise)
        features[self._layout["gripper position"]] += self._offset + noise
        features[self._layout["gripper velocity"]] += 0.0 if self._noise is None else noise - self._noise
        for quantity in self._layout:
            if quantity.name.endswith("position less gripper position"):
                features[self._layout[quantity.name]] -= self._offset + noise
        self._noise = noise
        target = self._look(self._robot.target()) if self._target is None else self._target
        target = target + self._draw(self._conditions.goal_noise)
        if self._tracks:
            features = np.append(features, target - features[:3])
        return features, np.append(target, np.ones(self._goal_size - 3))  # 1: the cube is to be held there

    def _draw(self, deviation: float) -> np.ndarray:
        return deviation * self._rng.standard_normal(3) if deviation else np.zeros(3)

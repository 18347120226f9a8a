"""What acts in an episode on a robot, and what the episode is disturbed by."""

import dataclasses
from collections.abc import Callable

import numpy as np

MeanAction = Callable[[np.ndarray], np.ndarray]
"""A policy's mean action, `[4]`, for an observation of the task that it was trained on, `[observation_size]`."""
Estimate = Callable[[np.ndarray, np.random.Generator], np.ndarray]
"""Where the target is believed to be, `[3]`, given where it is, `[3]`, and a source of randomness; metres, in the
policy's frame. An episode calls it once, at its start."""


@dataclasses.dataclass(frozen=True)
class NoisyEstimate:
    """An `Estimate` that is off by a constant and by Gaussian noise; by default it is exact."""

    noise: float = 0.0
    """Standard deviation of each coordinate, metres; drawn once per episode."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Metres, the same in every episode."""

    def __call__(self, position: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Returns the estimate, `[3]`, of a position, `[3]`."""
        return position + np.asarray(self.offset) + self.noise * rng.standard_normal(3)


@dataclasses.dataclass(frozen=True)
class Conditions:
    """What an episode is disturbed by; by default nothing."""

    estimate: Estimate = NoisyEstimate()
    """Where the policy is told that the target is; success is judged by where it really is."""
    delay: int = 0
    """Steps between an observation and the action that answers it; the robot stands still until the first arrives."""
    stride: float = 1.0
    """Factor on each displacement, between the policy and the robot."""
    goal_noise: float = 0.0
    """Standard deviation of each coordinate of the target's position at each step, metres."""
    robot_noise: float = 0.0
    """Likewise, of the gripper's position that the policy is told."""
    robot_offset: float = 0.0
    """Likewise, drawn once per episode."""
    friction: float = 1.0
    """Factor on the friction of all contacts."""
    object_mass: float = 1.0
    """Factor on the cube's mass."""
    gravity: float = 0.0
    """Share of the arm's weight that is not compensated, where the robot's model compensates it."""

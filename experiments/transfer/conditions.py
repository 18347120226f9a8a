"""Policies, and the conditions of an episode on a robot."""

import dataclasses
from collections.abc import Callable

import numpy as np

MeanAction = Callable[[np.ndarray], np.ndarray]
"""A policy's mean action, `[4]`, for an observation of the task that it was trained on, `[observation_size]`."""
Look = Callable[[np.ndarray], np.ndarray]
"""Estimate of the target's position, `[3]`, from the true one, `[3]`; metres, in the policy's frame. An episode looks
once, at its start, or, if its policy tracks the cube, at each step."""
Estimate = Callable[[np.random.Generator], Look]
"""Begins an episode's looks, with the generator of their errors."""


@dataclasses.dataclass(frozen=True)
class NoisyEstimate:
    """An `Estimate` with a constant offset and Gaussian noise; exact by default."""

    noise: float = 0.0
    """Standard deviation of each coordinate, metres; drawn once per episode."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Metres, the same in every episode."""

    def __call__(self, rng: np.random.Generator) -> Look:
        """Draws an episode's error, and returns its look."""
        error = np.asarray(self.offset) + self.noise * rng.standard_normal(3)
        return lambda position: position + error


@dataclasses.dataclass(frozen=True)
class Conditions:
    """Conditions of an episode; nominal by default."""

    estimate: Estimate = NoisyEstimate()
    """The target's position in the observation; success is judged by the true one."""
    delay: int = 0
    """Steps between an observation and the action that answers it; the robot stands still until the first arrives."""
    stride: float = 1.0
    """Factor on each displacement, between the policy and the robot."""
    goal_noise: float = 0.0
    """Standard deviation of the observed target's coordinates at each step, metres."""
    robot_noise: float = 0.0
    """Standard deviation of the observed gripper's coordinates at each step, metres."""
    robot_offset: float = 0.0
    """Standard deviation of an error of the observed gripper's coordinates, drawn once per episode, metres."""
    friction: float = 1.0
    """Factor on the friction of all contacts."""
    object_mass: float = 1.0
    """Factor on the cube's mass."""
    gravity: float = 0.0
    """Fraction of the arm's weight that is not compensated, in a model that compensates it."""

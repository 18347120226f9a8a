"""The tasks of tables and curves, policies, and the conditions of an episode on a robot."""

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


@dataclasses.dataclass(frozen=True)
class Task:
    """Task of transferred policies."""

    paper_success: float | None
    """Success rate that the paper reports on the real UR5; None if it reports none."""
    paper_distance_l1: float | None
    """L1 distance that the paper reports there, metres."""
    seen_by_cameras: bool = True
    """True if cameras can see the target: a ball that is put there, or the cube."""


TASKS = {
    "reach": Task(paper_success=0.95, paper_distance_l1=0.01),
    "grasp": Task(paper_success=0.93, paper_distance_l1=0.02),
    "pick-and-place": Task(None, None, seen_by_cameras=False),
}
"""The tasks of the tables and curves, by their names in `hgail_envs.TASKS`; a robot may do others too."""

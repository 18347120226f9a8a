"""Runs a policy on a robot that it was not trained on, and judges how the episode ended."""

import collections
import dataclasses
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from envs import EpisodeMetrics, GoalEnv, find_class
from envs.fetch.grasp import LEAST_RISE
from experiments.transfer.robots.base import Robot

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


def run_episode(
    robot: Robot,
    policy: MeanAction,
    rng: np.random.Generator,
    conditions: Conditions | None = None,
    watch: Callable[[], None] = lambda: None,
) -> EpisodeMetrics:
    """Runs one episode from the robot's present state, followed by the probe if the task has one.

    Args:
      robot: already reset.
      policy: decides the actions.
      rng: for the estimate of the target's position.
      conditions: what disturbs the episode; None is nothing.
      watch: called at the start and after each step.

    Returns:
      What `GoalEnv.outcome` of the robot's task would measure, as plain numbers.

    """
    conditions = conditions or Conditions()
    task = find_class(robot.task)
    believed = conditions.estimate(robot.target(), rng)
    goal = np.append(believed, np.ones(task.goal_size - len(believed)))  # 1: to hold the cube there, the object's place
    pending = collections.deque([np.zeros(task.action_size, np.float32)] * conditions.delay)
    factors = np.append(np.full(3, conditions.stride), 1.0)  # the hand's command is not a displacement
    watch()
    for _ in range(task.episode_length):
        action = policy(np.concatenate([robot.features(), goal]).astype(np.float32))
        pending.append(np.clip(action, -1.0, 1.0) * factors)
        action = pending.popleft()
        robot.step(action)
        watch()
    position, target = robot.carried(), robot.target()
    achieved = bool(robot.features()[7]) if task.probe_length else robot.reached()  # 7: whether the hand holds the cube
    for _ in range(task.probe_length):
        robot.step(np.array([0.0, 0.0, 1.0, action[3]]))  # straight up, the hand as it was: `Grasp.probe_action`
        watch()
    rise = robot.target()[2] - target[2] if task.probe_length else np.inf
    return _judge(task, position, target, achieved, achieved and rise > LEAST_RISE)


def run_episodes(
    robot: Robot,
    policies: Sequence[MeanAction],
    indices: Iterable[int],
    seed: int = 0,
    conditions: Conditions | None = None,
) -> list[EpisodeMetrics]:
    """Runs the episodes with these indices, the policies taking turns.

    An episode's start depends on the seed and its index alone, so that all conditions are compared on the same starts.
    """
    outcomes = []
    for index in indices:
        start_rng, estimate_rng = episode_rngs(seed, index)
        robot.reset(start_rng)
        outcomes.append(run_episode(robot, policies[index % len(policies)], estimate_rng, conditions))
    return outcomes


def episode_rngs(seed: int, index: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Returns an episode's random generators, for its start and for the estimate of the target's position."""
    start_rng, estimate_rng = np.random.default_rng((seed, index)).spawn(2)
    return start_rng, estimate_rng


def _judge(
    task: type[GoalEnv], position: np.ndarray, target: np.ndarray, achieved: bool, success: bool
) -> EpisodeMetrics:
    """Returns the metrics of the last step, given where what was to come to the target is."""
    l1, l2 = np.abs(position - target).sum(), np.linalg.norm(position - target)
    return EpisodeMetrics(
        success=float(success),
        achieved=float(achieved),
        success_l1=float(l1 <= task.success_threshold),
        distance_l1=float(l1),
        distance_l2=float(l2),
    )

"""Runs a policy on a robot that it was not trained on, and judges how the episode ended."""

import collections
import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from envs import EpisodeMetrics, GoalEnv, find_class
from envs.fetch.grasp import LEAST_RISE

if TYPE_CHECKING:  # imported later than envs, which chooses what MuJoCo renders with
    import mujoco

Policy = Callable[[np.ndarray], np.ndarray]
"""A mean action, `[4]`, for an observation of the task that the policy was trained on."""
Estimate = Callable[[np.ndarray, np.random.Generator], np.ndarray]
"""Where the target is believed to be, `[3]`, given where it is, `[3]`, and what is random in the belief; metres, in the
frame of the policy. It is asked once, at the start of an episode."""


class Robot(Protocol):
    """A simulated robot with its scene, that can do the task `reach` or `grasp`.

    Positions are metres in the frame of the policy, which is the Fetch scene's world frame.
    """

    task: str
    """`"reach"` or `"grasp"`."""
    model: "mujoco.MjModel"
    """The scene."""
    data: "mujoco.MjData"
    """Its state."""
    offset: np.ndarray
    """`[3]`: what is added to a position in the scene's world frame to have it in the frame of the policy."""
    cube: str
    """Name of the cube's geom, where the task is `grasp`."""
    marker: str
    """Name of the site that shows the target in pictures."""

    def reset(self, rng: np.random.Generator) -> None:
        """Puts the robot to its start, and a new target into the scene."""

    def features(self) -> np.ndarray:
        """Returns what the policy sees besides the goal, as `envs.fetch.reach.Reach` or `envs.fetch.grasp.Grasp` has it."""

    def target(self) -> np.ndarray:
        """Returns where the target is: the point to reach, or the cube's centre, `[3]`."""

    def step(self, action: np.ndarray) -> None:
        """Acts for `CONTROL_PERIOD`; displacements beyond 1, up to 2, are longer ones than any policy asks for."""


def exact(position: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns the position itself."""
    del rng
    return position


def mistaken(noise: float = 0.0, offset: Sequence[float] = (0.0, 0.0, 0.0)) -> Estimate:
    """Returns an estimate that is off by the same `offset`, `[3]`, in each episode, and by Gaussian noise.

    Args:
      noise: standard deviation of each coordinate, metres; drawn once an episode.
      offset: metres.

    """
    return lambda position, rng: position + np.asarray(offset) + noise * rng.standard_normal(3)


@dataclasses.dataclass(frozen=True)
class Conditions:
    """What an episode is made harder by; the defaults are none of it."""

    estimate: Estimate = exact
    """Where the policy is told that the target is. Success is judged by where it is."""
    delay: int = 0
    """Steps between an observation and the action that answers it; until the first arrives, the robot stands still."""
    stride: float = 1.0
    """What displacements are multiplied by, on the way to the robot."""


def run_episode(
    robot: Robot,
    policy: Policy,
    rng: np.random.Generator,
    conditions: Conditions | None = None,
    watch: Callable[[], None] = lambda: None,
) -> EpisodeMetrics:
    """Runs one episode, and the probe where the task has one, from the state that the robot is in.

    Args:
      robot: what acts; see `Robot.reset`.
      policy: what decides.
      rng: of the estimate.
      conditions: see there.
      watch: called at the start and after each step.

    Returns:
      what `GoalEnv.outcome` of the robot's task measures, as numbers.

    """
    conditions = conditions or Conditions()
    task = find_class(robot.task)
    believed = conditions.estimate(robot.target(), rng)
    goal = np.append(believed, 1.0) if robot.task == "grasp" else believed
    waiting = collections.deque([np.zeros(task.action_size, np.float32)] * conditions.delay)
    watch()
    for _ in range(task.episode_length):
        action = policy(np.concatenate([robot.features(), goal]).astype(np.float32))
        waiting.append(np.clip(action, -1.0, 1.0) * np.append(np.full(3, conditions.stride), 1.0))
        action = waiting.popleft()
        robot.step(action)
        watch()
    features, target = robot.features(), robot.target()
    for _ in range(task.probe_length):
        robot.step(np.array([0.0, 0.0, 1.0, action[3]]))
        watch()
    return _judge(task, features, target, rise=robot.target()[2] - target[2])


def run_episodes(
    robot: Robot,
    policies: Sequence[Policy],
    indices: Iterable[int],
    seed: int = 0,
    conditions: Conditions | None = None,
) -> list[EpisodeMetrics]:
    """Runs the episodes with these numbers, the policies taking turns.

    An episode's start depends on the seed and its number alone, so that conditions are compared on the same starts.
    """
    outcomes = []
    for index in indices:
        start, error = np.random.default_rng((seed, index)).spawn(2)
        robot.reset(start)
        outcomes.append(run_episode(robot, policies[index % len(policies)], error, conditions))
    return outcomes


def _judge(task: type[GoalEnv], features: np.ndarray, target: np.ndarray, rise: float) -> EpisodeMetrics:
    l1, l2 = np.abs(features[:3] - target).sum(), np.linalg.norm(features[:3] - target)
    threshold = task.success_threshold
    achieved = bool(features[7]) if task.probe_length else l2 <= threshold
    return EpisodeMetrics(
        success=float(achieved and (rise > LEAST_RISE or not task.probe_length)),
        achieved=float(achieved),
        success_l1=float(l1 <= threshold),
        distance_l1=float(l1),
        distance_l2=float(l2),
    )

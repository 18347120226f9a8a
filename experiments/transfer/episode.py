"""Runs a policy on a robot that it was not trained on, and measures the outcome."""

import collections
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from experiments.transfer.conditions import Conditions, MeanAction
from experiments.transfer.model_changes import changed
from experiments.transfer.observing import Sensors, trained_under
from experiments.transfer.robots.base import Robot
from hgail_envs import EpisodeMetrics, GoalEnv, find_class
from hgail_envs.fetch.grasp import LEAST_RISE
from hgail_envs.past import Past


def run_episode(
    robot: Robot,
    policy: MeanAction,
    rng: np.random.Generator,
    conditions: Conditions | None = None,
    watch: Callable[[], None] = lambda: None,
) -> EpisodeMetrics:
    """Runs one episode from the robot's present state, and the lift test if the task has one.

    Args:
      robot: already reset.
      policy: decides the actions.
      rng: for the estimate of the target's position.
      conditions: of the episode; None is nominal.
      watch: called at the start and after each step.

    Returns:
      Metrics of the last step, as `GoalEnv.outcome` of the robot's task defines them, as plain numbers.

    """
    conditions = conditions or Conditions()
    with changed(robot, conditions.friction, conditions.object_mass, conditions.gravity):
        return _run(robot, policy, rng, conditions, watch)


def _run(
    robot: Robot, policy: MeanAction, rng: np.random.Generator, conditions: Conditions, watch: Callable[[], None]
) -> EpisodeMetrics:
    """Runs the episode in the robot's present model; see `run_episode`."""
    task = find_class(robot.task)
    pending = collections.deque([np.zeros(task.action_size, np.float32)] * conditions.delay)
    factors = np.append(np.full(3, conditions.stride), 1.0)  # the hand's command is not a displacement
    sensors = Sensors(robot, policy, rng, conditions)
    trained = trained_under(policy)
    past = Past(trained, min(conditions.delay, trained.known_delay))  # of a longer delay it knows the newest actions
    watch()
    for _ in range(task.episode_length):
        seen, goal = sensors.observe()
        action = policy(np.concatenate([past.before(seen), seen, goal]).astype(np.float32))
        past.add(np.clip(action, -1.0, 1.0), seen)
        pending.append(np.clip(action, -1.0, 1.0) * factors)
        action = pending.popleft()
        robot.step(action)
        watch()
    position, target = robot.carried(), robot.target()
    achieved = bool(robot.features()[7]) if task.lift_test_steps else robot.reached()  # 7: the hand holds the cube
    for _ in range(task.lift_test_steps):
        robot.step(np.array([0.0, 0.0, 1.0, action[3]]))  # straight up, the hand as it was: `Grasp.lift_test_action`
        watch()
    rise = robot.target()[2] - target[2] if task.lift_test_steps else np.inf
    return _judge(task, position, target, achieved, achieved and rise > LEAST_RISE)


def run_episodes(
    robot: Robot,
    policies: Sequence[MeanAction],
    indices: Iterable[int],
    seed: int = 0,
    conditions: Conditions | None = None,
) -> list[EpisodeMetrics]:
    """Runs the episodes with these indices, the policies taking turns.

    An episode's start depends on the seed and its index alone, so all conditions are compared on the same starts.
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
    """Returns the metrics of the last step, from the position of the gripper or object and its target's."""
    l1, l2 = np.abs(position - target).sum(), np.linalg.norm(position - target)
    return EpisodeMetrics(
        success=float(success),
        achieved=float(achieved),
        success_l1=float(l1 <= task.success_threshold),
        distance_l1=float(l1),
        distance_l2=float(l2),
    )

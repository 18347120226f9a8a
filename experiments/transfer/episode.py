"""Runs a policy on a robot that it was not trained on, and measures the outcome."""

import collections
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from experiments.transfer.conditions import Conditions, MeanAction
from experiments.transfer.model_changes import changed
from experiments.transfer.observing import Sensors, trained_under
from experiments.transfer.robots.base import Robot
from hgail_envs import EpisodeMetrics, find_class
from hgail_envs.fetch import episode
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
    action_size = find_class(robot.task).action_size
    pending = collections.deque([np.zeros(action_size, np.float32)] * conditions.delay)
    factors = np.append(np.full(3, conditions.stride), 1.0)  # the hand's command is not a displacement
    sensors = Sensors(robot, policy, rng, conditions)
    trained = trained_under(policy)
    past = Past(trained, min(conditions.delay, trained.known_delay))  # of a longer delay it knows the newest actions

    def act() -> np.ndarray:
        seen, goal = sensors.observe()
        action = np.clip(policy(np.concatenate([past.before(seen), seen, goal]).astype(np.float32)), -1.0, 1.0)
        past.add(action, seen)
        pending.append(action * factors)
        return pending.popleft()

    return episode.run_episode(robot, act, watch)


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

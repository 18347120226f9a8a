"""A number that actions move, and roll-outs of it by hand."""

import jax
import jax.numpy as jnp
import numpy as np

from hgail_envs.base import EpisodeMetrics, GoalEnv
from hgail_jax.rollout import Trajectory

LENGTH, EPISODES = 6, 40
RNG = np.random.default_rng(0)


class Line(GoalEnv):
    """A number that actions move; a goal is a number and its kind, and what is achieved is of kind 1 above 2."""

    episode_length, feature_size, goal_size, action_size, success_threshold = LENGTH, 1, 2, 1, 0.5
    goal_kinds = 2
    observation_limit = 50.0

    def reset_physics(self, rng):
        return jax.random.uniform(rng, (1,))

    def step_physics(self, physics, action):
        return physics + action

    def features(self, physics):
        return physics

    def achieved_goal(self, physics):
        return jnp.append(physics, (physics > 2.0).astype(jnp.float32))

    def sample_goal(self, rng, physics):
        return jnp.array([1.0, 0.0])

    def plan_goals(self, rng, physics, training_goals):
        return jnp.where(training_goals, jnp.array([-1.0, 1.0]), self.sample_goal(rng, physics))

    def goal_kind(self, goal):
        return goal[..., 1].astype(jnp.int32)


ENV = Line()


def trajectory(episodes=EPISODES, kind=None, valid=None, **changes):
    """A roll-out in which the achieved goal (100 n + t, kind) says that it is of step t of episode n."""
    time, episode = np.mgrid[: LENGTH + 1, :episodes].astype(np.float32)
    kind = np.zeros_like(time) if kind is None else kind
    wanted = np.stack([-time - 100 * episode - 1, np.broadcast_to(np.arange(episodes) % 4 == 0, time.shape)], axis=-1)
    leaves = {
        "features": 0.5 + time[..., None] + 100 * episode[..., None],
        "achieved": np.stack([time + 100 * episode, kind], axis=-1),
        "desired": wanted.astype(np.float32),
        "action": RNG.normal(size=(LENGTH, episodes, 1)).astype(np.float32),
        "noted": np.zeros((LENGTH, episodes), np.float32),
        "reward": -RNG.integers(0, 2, (LENGTH, episodes)).astype(np.float32),
        "valid": np.ones(episodes, bool) if valid is None else valid,
        "overflow": np.zeros(episodes, bool),
        "outcome": EpisodeMetrics(distance_l1=RNG.uniform(size=episodes).astype(np.float32)),
    } | changes
    return jax.tree.map(jnp.asarray, Trajectory(**leaves))


def assert_same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)

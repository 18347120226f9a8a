"""Measures how well episodes end."""

import jax
import jax.numpy as jnp
from flax import struct

from envs import GoalEnv
from hgail_jax.rollout import Policy, Trajectory, rollout


class EpisodeMetrics(struct.PyTreeNode):
    """Where episodes ended, by the last step alone. One number per episode, `[N]`, or their mean, `[]`."""

    success: jax.Array | float = 0.0
    """1 where the last achieved goal satisfies the task, else 0."""
    success_l1: jax.Array | float = 0.0
    """1 where the L1 distance is within the task's threshold, as in the paper, else 0."""
    distance_l1: jax.Array | float = 0.0
    """Sum of absolute differences between achieved and desired goal, in the goal's unit."""
    distance_l2: jax.Array | float = 0.0
    """Euclidean distance between them."""

    def mean(self) -> "EpisodeMetrics":
        """Returns the mean over episodes."""
        return jax.tree.map(jnp.mean, self)


def episode_metrics(env: GoalEnv, trajectory: Trajectory) -> EpisodeMetrics:
    """Returns the metrics of each of the `N` episodes of a trajectory."""
    achieved, desired = trajectory.achieved[-1], trajectory.desired
    l1 = jnp.sum(jnp.abs(achieved - desired), axis=-1)
    return EpisodeMetrics(
        success=env.success(achieved, desired).astype(jnp.float32),
        success_l1=(l1 <= env.success_threshold).astype(jnp.float32),
        distance_l1=l1,
        distance_l2=jnp.linalg.norm(achieved - desired, axis=-1),
    )


def evaluate(env: GoalEnv, policy: Policy, rng: jax.Array, num_episodes: int) -> EpisodeMetrics:
    """Runs `policy` for `num_episodes` fresh episodes and returns their mean metrics; jit it."""
    return episode_metrics(env, rollout(env, policy, rng, num_episodes)).mean()

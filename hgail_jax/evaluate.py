"""Measures how well episodes end."""

import jax
import jax.numpy as jnp

from envs import EpisodeMetrics, GoalEnv
from hgail_jax.rollout import Policy, Trajectory, rollout


def mean_outcome(trajectory: Trajectory) -> EpisodeMetrics:
    """Returns the means over a trajectory's episodes, `[]`.

    An episode whose simulation broke down counts as a failure, and in no distance; where all did, the distances are
    not a number.
    """
    means = jax.tree.map(jnp.mean, trajectory.outcome)
    sound = jnp.where(trajectory.sound.any(), trajectory.sound.mean(), jnp.nan)
    return means.replace(distance_l1=means.distance_l1 / sound, distance_l2=means.distance_l2 / sound)


def evaluate(env: GoalEnv, policy: Policy, rng: jax.Array, num_episodes: int) -> EpisodeMetrics:
    """Runs `policy` for `num_episodes` fresh episodes, with the task's probe, and returns their means; jit it.

    It does not say whether the simulation ran out of room for contacts; `hgail_jax.distributed.seeds.evaluate_seeds`
    raises an error then.
    """
    return mean_outcome(rollout(env, policy, rng, num_episodes, probe=True))

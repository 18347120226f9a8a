"""The one evaluation: episodes of a policy, and the means of how they ended."""

import functools

import jax
import jax.numpy as jnp

from hgail_envs import EpisodeMetrics, GoalEnv
from hgail_envs.validation import check_count
from hgail_jax.rollout import Policy, Trajectory, rollout


def mean_outcome(trajectory: Trajectory) -> EpisodeMetrics:
    """Returns the means over a trajectory's episodes, `[]`.

    An episode whose simulation broke down counts as a failure, and in no distance; where all did, the distances are
    NaN.
    """
    means = jax.tree.map(jnp.mean, trajectory.outcome)
    valid = jnp.where(trajectory.valid.any(), trajectory.valid.mean(), jnp.nan)
    return means.replace(distance_l1=means.distance_l1 / valid, distance_l2=means.distance_l2 / valid)


def evaluate(env: GoalEnv, policy: Policy, rng: jax.Array, num_episodes: int) -> EpisodeMetrics:
    """Runs `policy` for `num_episodes` fresh episodes side by side, with the task's lift test; jit it.

    Returns the means over the episodes, `[]`. It does not say whether the simulation ran out of room for contacts;
    `hgail_jax.seeds.evaluate_seeds` raises an error then.
    """
    return mean_outcome(rollout(env, policy, rng, num_episodes, lift_test=True))


def evaluate_rollouts(
    env: GoalEnv, policy: Policy, rng: jax.Array, rollouts: int, num_envs: int, axis: str | None = None
) -> tuple[EpisodeMetrics, jax.Array]:
    """Runs `policy` for some roll-outs of `num_envs` episodes, one after another.

    Args:
      env: the task.
      policy: what acts.
      rng: a PRNG key.
      rollouts: their number.
      num_envs: episodes side by side in each.
      axis: see `rollout`.

    Returns:
      The means over all episodes, `[]`, and whether the simulation ran out of room for contacts, a boolean `[]`.

    """

    def roll_out(rng: jax.Array) -> tuple[EpisodeMetrics, jax.Array]:
        trajectory = rollout(env, policy, rng, num_envs, lift_test=True, axis=axis)
        return mean_outcome(trajectory), trajectory.overflow.any()

    outcomes, overflow = jax.lax.map(roll_out, jax.random.split(rng, rollouts))
    # A roll-out in which every episode broke has no distance; the others have the mean one.
    return jax.tree.map(functools.partial(jnp.nanmean, axis=0), outcomes), overflow.any()


def whole_rollouts(num_episodes: int, num_envs: int) -> int:
    """Returns how many roll-outs of `num_envs` episodes have at least `num_episodes`.

    Raises:
      ValueError: `num_episodes` is no count from 1.

    >>> whole_rollouts(100, 64)
    2

    """
    check_count("num_episodes", num_episodes)
    return -(-num_episodes // num_envs)

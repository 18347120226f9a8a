"""The one evaluation: episodes of a policy, and the means of how they ended."""

import jax
import jax.numpy as jnp

from hgail_envs import EpisodeMetrics, GoalEnv
from hgail_envs.validation import check_count
from hgail_jax.rollout import Policy, Trajectory, rollout


def mean_outcome(trajectory: Trajectory) -> EpisodeMetrics:
    """Returns the means over a trajectory's episodes, `[]`; broken simulations are failures, and in no distance."""
    outcome, valid = trajectory.outcome, trajectory.valid
    distances = {name: measured_mean(getattr(outcome, name), valid) for name in ("distance_l1", "distance_l2")}
    return jax.tree.map(jnp.mean, outcome).replace(**distances)


def measured_mean(values: jax.Array, measured: jax.Array) -> jax.Array:
    """Returns the mean, `[]`, of the finite values that were measured, `[N]`; infinity where none was.

    It is not NaN there, so that `jax_debug_nans` finds only what is wrong.
    """
    measured = measured & jnp.isfinite(values)
    count = measured.sum().astype(values.dtype)
    return jnp.where(count > 0, jnp.where(measured, values, 0.0).sum() / jnp.maximum(count, 1.0), jnp.inf)


def evaluate(env: GoalEnv, policy: Policy, rng: jax.Array, num_episodes: int) -> EpisodeMetrics:
    """Returns the means, `[]`, over `num_episodes` episodes side by side, with the task's lift test; jit it.

    It does not say whether the simulation ran out of room for contacts; `hgail_jax.seeds.evaluate_seeds` does.
    """
    return mean_outcome(rollout(env, policy, rng, num_episodes, lift_test=True))


def evaluate_rollouts(
    env: GoalEnv, policy: Policy, rng: jax.Array, rollouts: int, num_envs: int, axis: str | None = None
) -> tuple[EpisodeMetrics, jax.Array]:
    """Runs `policy` for some roll-outs of `num_envs` episodes, one after another; see `rollout` for `axis`.

    Returns the means over all episodes, `[]`, and whether the simulation ran out of room for contacts, a boolean `[]`.
    """

    def roll_out(rng: jax.Array) -> tuple[EpisodeMetrics, jax.Array]:
        trajectory = rollout(env, policy, rng, num_envs, lift_test=True, axis=axis)
        return mean_outcome(trajectory), trajectory.overflow.any()

    outcomes, overflow = jax.lax.map(roll_out, jax.random.split(rng, rollouts))
    # A roll-out in which every episode broke has no distance; the others have the mean one.
    return jax.tree.map(lambda values: measured_mean(values, jnp.ones(rollouts, bool)), outcomes), overflow.any()


def whole_rollouts(num_episodes: int, num_envs: int) -> int:
    """Returns how many roll-outs of `num_envs` episodes have at least `num_episodes`, which must be a count from 1.

    >>> whole_rollouts(100, 64)
    2
    """
    check_count("num_episodes", num_episodes)
    return -(-num_episodes // num_envs)

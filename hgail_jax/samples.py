"""Samples: the steps of roll-outs, which discriminator and behaviour cloning are fitted to.

Below, `T` is the steps of an episode, `N` the episodes of a roll-out and `S` their product.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from hgail_envs import GoalEnv
from hgail_jax.config import Hyperparameters
from hgail_jax.hindsight import bisect, relabel
from hgail_jax.rollout import Trajectory

_LEAST_SHARE = 1e-6  # of a kind of goal that does not occur: it is drawn only where there is no other


class Samples(struct.PyTreeNode):
    """Steps without their order."""

    observation: jax.Array
    """`[S, observation_size]`, not normalised."""
    action: jax.Array
    """`[S, action_size]`, not clipped."""
    weight: jax.Array
    """`[S]`: how often to draw each, relative to the others; 0 for episodes whose simulation broke down."""

    def draw(self, rng: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Returns indices of samples, drawn with replacement by their weights.

        First a block of samples is drawn, then one of the block: a random number in single precision has 23 bits, and a
        sum of weights hardly more, so that one draw among millions of samples would leave some of them out.
        """
        samples = self.weight.shape[0]
        width = math.isqrt(samples - 1) + 1
        blocks = jnp.pad(self.weight, (0, -samples % width)).reshape(-1, width)
        totals, cumulative = jnp.cumsum(blocks.sum(axis=1)), jnp.cumsum(blocks, axis=1)
        which, where = jax.random.uniform(rng, (2, *shape))
        block = _first_above(totals[None], jnp.zeros(shape, jnp.int32), which * totals[-1])
        return block * width + _first_above(cumulative, block, where * cumulative[block, -1])


def _first_above(cumulative: jax.Array, block: jax.Array, target: jax.Array) -> jax.Array:
    """Returns the first column of row `block` whose number is above `target`, all three `[...]`.

    The rows of `cumulative`, `[blocks, width]`, grow to more than their targets.
    """
    width = cumulative.shape[1]
    low, high = jnp.zeros_like(block), jnp.full_like(block, width - 1)
    return bisect(lambda column: cumulative[block, column] > target, low, high, width)


def pursued_samples(env: GoalEnv, trajectory: Trajectory) -> Samples:
    """Returns the steps of a trajectory under the goals it pursued, still in their order: leaves `[T, N, ...]`."""
    return Samples(trajectory.observation(env)[:-1], trajectory.action, step_weight(trajectory))


def policy_samples(env: GoalEnv, trajectory: Trajectory) -> Samples:
    """Returns the samples of a trajectory under the goals it pursued."""
    return flatten(pursued_samples(env, trajectory))


def negative_samples(env: GoalEnv, hyper: Hyperparameters, trajectory: Trajectory, rng: jax.Array) -> Samples:
    """Returns the samples of a trajectory under the goals it pursued, or at the same step in another episode.

    The fraction of others is `hyper.shuffled_goals`; there must be two episodes.
    """
    desired = trajectory.desired[:-1]
    others = jnp.roll(desired, desired.shape[1] // 2, axis=1)
    goal = jnp.where(jax.random.bernoulli(rng, hyper.shuffled_goals, (*desired.shape[:2], 1)), others, desired)
    observation = env.goal_observation(trajectory.features[:-1], goal)
    return flatten(Samples(observation, trajectory.action, step_weight(trajectory)))


def relabelled_samples(
    env: GoalEnv,
    hyper: Hyperparameters,
    trajectory: Trajectory,
    rng: jax.Array,
    jitter: jax.Array | float = 0.0,
) -> Samples:
    """Returns the samples of a trajectory under goals replaced in hindsight, then jittered, see `jitter_goals`.

    Their weights give each kind of goal the share that it has among the goals pursued, see `GoalEnv.goal_kind`. Within
    a kind, samples whose goal is solved already count `hyper.solved_weight` times.
    """
    desired, weight = trajectory.desired[:-1], step_weight(trajectory)
    share = kind_share(env, desired, weight)

    def relabel_one(rng: jax.Array, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        kind = env.goal_kind(achieved)
        return relabel(rng, achieved, desired, hyper.p_ht, hyper.strategy, hyper.include_current, kind, share).goal

    rngs = jax.random.split(rng, desired.shape[1])
    goal = jax.vmap(relabel_one, in_axes=(0, 1, 1), out_axes=1)(rngs, trajectory.achieved, desired)
    features = trajectory.features[:-1]
    weight = weight * jnp.where(env.already_solved(features, goal), hyper.solved_weight, 1.0)
    weight = weight * (share / kind_share(env, goal, weight))[env.goal_kind(goal)]
    goal = jitter_goals(env, goal, jitter, jax.random.fold_in(rng, desired.shape[1]))
    return flatten(Samples(env.goal_observation(features, goal), trajectory.action, weight))


def jitter_goals(env: GoalEnv, goal: jax.Array, size: jax.Array | float, rng: jax.Array) -> jax.Array:
    """Draws a goal uniformly from a box around each of `goal`, `[..., goal_size]`: `size` times its tolerance."""
    return goal + size * env.goal_tolerance(goal) * jax.random.uniform(rng, goal.shape, minval=-1.0)


def shuffle_goals(goal: jax.Array, share: jax.Array | float, rng: jax.Array) -> jax.Array:
    """Gives a fraction of samples the goal of another one; `goal` is `[S, goal_size]`, in a random order, S above 1."""
    others = jnp.roll(goal, len(goal) // 2, axis=0)
    return jnp.where(jax.random.bernoulli(rng, share, (len(goal), 1)), others, goal)


def kind_share(env: GoalEnv, goal: jax.Array, weight: jax.Array) -> jax.Array:
    """Fraction of each kind, `[goal_kinds]`, among goals `[T, N, goal_size]` of weights `[T, N]`; always positive."""
    of_kind = jax.nn.one_hot(env.goal_kind(goal), env.goal_kinds)
    return jnp.einsum("tnk,tn->k", of_kind, weight) / jnp.maximum(weight.sum(), 1.0) + _LEAST_SHARE


def step_weight(trajectory: Trajectory) -> jax.Array:
    """1 for the steps of valid episodes, else 0: `[T, N]`."""
    return jnp.broadcast_to(trajectory.valid, trajectory.reward.shape).astype(jnp.float32)


def flatten(tree: Any) -> Any:
    """Joins the first two axes, steps and episodes, of every leaf."""
    return jax.tree.map(lambda array: array.reshape(-1, *array.shape[2:]), tree)

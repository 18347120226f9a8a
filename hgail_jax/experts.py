"""Where the expert samples come from: the main choice in which the methods of imitation differ.

The discriminator and behaviour cloning use expert samples. They are one of

- `"relabelled"`: the roll-out at hand, relabelled in hindsight (HGAIL);
- `"frozen"`: the first roll-out of all, relabelled once (the paper's "no curriculum", Table 2);
- `"demonstrations"`: another's episodes (GAIL, Ho & Ermon 2016);
- `"best"`: the policy's own best episodes so far (GASIL, generative adversarial self-imitation, Guo et al. 2018).

All but the first are kept in the training state, as its `expert`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from hgail_envs import GoalEnv
from hgail_jax.config import BEST, DEMONSTRATIONS, FROZEN, RELABELLED, Config, Hyperparameters
from hgail_jax.rollout import Trajectory
from hgail_jax.samples import Samples, flatten, pursued_samples, relabelled_samples

_LEAST_RETURN = float(np.finfo(np.float32).min)  # of a place in the buffer that is empty, and of a broken episode


class BestEpisodes(struct.PyTreeNode):
    """GASIL's buffer: the `K` best episodes so far, best first; the places that are still empty have no weight."""

    samples: Samples
    """Leaves `[T, K, ...]`, under the goals pursued."""
    returns: jax.Array
    """`[K]`: sums of the environment's rewards, not discounted."""
    distance: jax.Array
    """`[K]`: L1 distances at the end."""


def init_expert(env: GoalEnv, config: Config, demonstrations: Samples | None) -> Any:
    """Returns the expert samples that a training state begins with: `Samples`, `BestEpisodes` or None.

    Demonstrations that the config does not ask for, or lacks, or of other sizes than the task's are a ValueError.
    """
    if (demonstrations is not None) != (config.expert_source == DEMONSTRATIONS):
        given = "none are given" if demonstrations is None else "demonstrations are given"
        raise ValueError(f"expert_source is {config.expert_source!r} and {given}")
    if demonstrations is not None:
        return _check(env, demonstrations)
    if config.expert_source == FROZEN:
        return _no_samples(env, config.num_envs * env.episode_length)
    if config.expert_source == BEST:
        count = config.best_episodes
        return BestEpisodes(
            samples=_no_samples(env, env.episode_length, count),
            returns=jnp.full(count, _LEAST_RETURN),
            distance=jnp.zeros(count),
        )
    return None


def expert_samples(
    env: GoalEnv,
    config: Config,
    hyper: Hyperparameters,
    expert: Any,
    trajectory: Trajectory,
    rng: jax.Array,
    jitter: jax.Array | float = 0.0,
) -> tuple[Any, Samples]:
    """Returns (new expert buffer, expert samples) after a roll-out; see `jitter_goals` for `jitter`."""
    if config.expert_source == RELABELLED:
        return expert, relabelled_samples(env, hyper, trajectory, rng, jitter)
    if config.expert_source == FROZEN:
        fresh, empty = relabelled_samples(env, hyper, trajectory, rng), ~(expert.weight > 0).any()
        expert = jax.tree.map(lambda new, old: jnp.where(empty, new, old), fresh, expert)
    if config.expert_source == BEST:
        expert = keep_best(env, hyper, expert, trajectory)
        return expert, flatten(expert.samples)
    return expert, expert


def keep_best(env: GoalEnv, hyper: Hyperparameters, best: BestEpisodes, trajectory: Trajectory) -> BestEpisodes:
    """Returns the best `K` of the `K` episodes kept and the `N` of a roll-out, by their return.

    Of episodes with equal returns the nearer to its goal at the end is better where `hyper.ties_by_distance`, then
    the one kept earlier.
    """
    count = best.returns.shape[0]
    fresh = BestEpisodes(
        samples=pursued_samples(env, trajectory),
        returns=jnp.where(trajectory.valid, trajectory.reward.sum(axis=0), _LEAST_RETURN),
        distance=jnp.asarray(trajectory.outcome.distance_l1),
    )
    returns = jnp.concatenate([best.returns, fresh.returns])
    distance = jnp.concatenate([best.distance, fresh.distance])
    order = jnp.lexsort((jnp.where(hyper.ties_by_distance, distance, 0.0), -returns))[:count]
    samples = jax.tree.map(
        lambda kept, new: jnp.concatenate([kept, new], axis=1)[:, order], best.samples, fresh.samples
    )
    return BestEpisodes(samples=samples, returns=returns[order], distance=distance[order])


def _check(env: GoalEnv, samples: Samples) -> Samples:
    observations, actions, weights = samples.observation.shape, samples.action.shape, samples.weight.shape
    count = weights[0] if weights else 0
    if (observations, actions, weights) != ((count, env.goal_observation_size), (count, env.action_size), (count,)):
        raise ValueError(
            f"demonstrations have observations {observations}, actions {actions} and weights {weights}; they must be"
            f" [S, {env.goal_observation_size}], [S, {env.action_size}] and [S]"
        )
    return jax.tree.map(jnp.asarray, samples)


def _no_samples(env: GoalEnv, *shape: int) -> Samples:
    return Samples(
        jnp.zeros((*shape, env.goal_observation_size)), jnp.zeros((*shape, env.action_size)), jnp.zeros(shape)
    )

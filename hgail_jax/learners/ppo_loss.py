"""Proximal policy optimisation: advantages and losses."""

import jax
import jax.numpy as jnp


def generalized_advantages(
    reward: jax.Array, value: jax.Array, discount: jax.Array | float, gae_lambda: jax.Array | float
) -> jax.Array:
    """Returns generalised advantage estimates (Schulman et al. 2016, Eq. 16) of rewards, both `[T, ...]`.

    Episodes end by their time limit alone, which is a truncation: the last step bootstraps from the value of the
    state it leads to, as every other step does. The values are `[T + 1, ...]`, of states 0 to T.
    """
    delta = reward + discount * value[1:] - value[:-1]

    def accumulate(advantage: jax.Array, delta: jax.Array) -> tuple[jax.Array, jax.Array]:
        advantage = delta + discount * gae_lambda * advantage
        return advantage, advantage

    return jax.lax.scan(accumulate, jnp.zeros_like(delta[0]), delta, reverse=True)[1]


def policy_loss(
    log_prob: jax.Array,
    old_log_prob: jax.Array,
    advantage: jax.Array,
    weight: jax.Array,
    clip_ratio: jax.Array | float,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Clipped surrogate loss (Schulman et al. 2017, Eq. 7) of a minibatch and `PPO.metrics` of it, all `[]`.

    Every argument but the last is `[B]`; `weight` is 1 where a sample counts and 0 where it does not. There is no
    entropy bonus: with a fixed covariance the entropy is constant.
    """
    log_ratio = log_prob - old_log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - clip_ratio, 1.0 + clip_ratio)
    loss = -weighted_mean(jnp.minimum(ratio * advantage, clipped * advantage), weight)
    outside = weighted_mean((jnp.abs(ratio - 1.0) > clip_ratio).astype(ratio.dtype), weight)
    return loss, {"policy_loss": loss, "clip_fraction": outside, "kl": weighted_mean(ratio - 1.0 - log_ratio, weight)}


def weighted_mean(values: jax.Array, weight: jax.Array) -> jax.Array:
    """Returns the mean of `values` under `weight`, which has their shape; 0 where no weight is positive."""
    return jnp.sum(values * weight) / jnp.maximum(jnp.sum(weight), 1e-8)


def standardize(values: jax.Array, weight: jax.Array) -> jax.Array:
    """Shifts and scales to mean 0 and standard deviation 1 under `weight`; constant values become 0."""
    centred = values - weighted_mean(values, weight)
    return centred / (jnp.sqrt(weighted_mean(jnp.square(centred), weight)) + 1e-8)

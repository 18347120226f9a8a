"""The three networks and the Gaussian policy."""

from collections.abc import Sequence
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp

from hgail_jax.config import Config

_LOG_SQRT_2PI = 0.9189385332046727


class MLP(nn.Module):
    """A tanh multilayer perceptron: `[..., inputs]` to `[..., outputs]`."""

    hidden: Sequence[int]
    outputs: int
    output_scale: float = 1.0
    """Factor on the initial weights of the last layer."""

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Applies the layers."""
        for width in self.hidden:
            inputs = nn.tanh(nn.Dense(width)(inputs))
        init = nn.initializers.variance_scaling(self.output_scale, "fan_in", "truncated_normal")
        return nn.Dense(self.outputs, kernel_init=init)(inputs)


def policy_network(config: Config, action_size: int) -> MLP:
    """Normalised observation to mean action; starts near zero, so that the first policy explores evenly."""
    return MLP(config.policy_hidden, action_size, output_scale=1e-4)


def value_network(config: Config) -> MLP:
    """Normalised observation to the expected return, `[..., 1]`."""
    return MLP(config.policy_hidden, 1)


def discriminator_network(config: Config) -> MLP:
    """Normalised observation and clipped action, concatenated, to the logit, `[..., 1]`."""
    return MLP(config.discriminator_hidden, 1)


def apply(network: MLP, params: Any, inputs: jax.Array) -> jax.Array:
    """Runs a network: `[..., inputs]` to `[..., outputs]`."""
    return cast(jax.Array, network.apply(params, inputs))


def gaussian_log_prob(action: jax.Array, mean: jax.Array, std: jax.Array | float) -> jax.Array:
    """Log-density of actions, `[..., action_size]`, under N(mean, std² I): `[...]`."""
    return jnp.sum(-0.5 * jnp.square((action - mean) / std) - jnp.log(std) - _LOG_SQRT_2PI, axis=-1)

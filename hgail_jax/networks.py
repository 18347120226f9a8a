"""The multilayer perceptron that every network is, and the density of the Gaussian policy."""

from collections.abc import Sequence
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp

_LOG_SQRT_2PI = 0.9189385332046727


class MLP(nn.Module):
    """A multilayer perceptron: `[..., inputs]` to `[..., outputs]`."""

    hidden: Sequence[int]
    outputs: int
    output_scale: float = 1.0
    """Factor on the initial weights of the last layer."""
    layer_norm: bool = False
    """Whether hidden layers are ReLU after layer normalisation; else tanh."""

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Applies the layers."""
        for width in self.hidden:
            inputs = nn.Dense(width)(inputs)
            inputs = nn.relu(nn.LayerNorm()(inputs)) if self.layer_norm else nn.tanh(inputs)
        init = nn.initializers.variance_scaling(self.output_scale, "fan_in", "truncated_normal")
        return nn.Dense(self.outputs, kernel_init=init)(inputs)


def apply(network: nn.Module, params: Any, inputs: jax.Array) -> jax.Array:
    """Runs a network: `[..., inputs]` to `[..., outputs]`."""
    return cast(jax.Array, network.apply(params, inputs))


def dense_layers(params: Any) -> list[tuple[jax.Array, ...]]:
    """Returns the layers of an `MLP`: weights, biases and, of a layer normalisation, scale and offset."""
    found = params["params"]
    dense = [found[f"Dense_{index}"] for index in range(sum(name.startswith("Dense") for name in found))]
    norms = [found.get(f"LayerNorm_{index}") for index in range(len(dense))]
    return [
        (layer["kernel"], layer["bias"], *(() if norm is None else (norm["scale"], norm["bias"])))
        for layer, norm in zip(dense, norms, strict=True)
    ]


def gaussian_log_prob(action: jax.Array, mean: jax.Array, std: jax.Array | float) -> jax.Array:
    """Log-density of actions, `[..., action_size]`, under N(mean, std² I): `[...]`."""
    std, log_std = (jnp.broadcast_to(of_all, action.shape) for of_all in (std, jnp.log(std)))
    return jnp.sum(-0.5 * jnp.square((action - mean) / std) - log_std - _LOG_SQRT_2PI, axis=-1)

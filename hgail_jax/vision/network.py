"""The network that sees: pictures and the robot's own numbers to an action and to where the objects are.

Four convolutions, the place of each of their features in the picture (spatial soft-argmax, Finn et al. 2016), and two
hidden layers. Its parameters are plain arrays, so that training and a policy's file share this one function.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hgail_envs.validation import check_count
from hgail_jax.policy import NORM_EPSILON

KERNELS = (5, 3, 3, 3)
"""Edges of the convolutions' kernels, pixels."""
STRIDES = (2, 2, 1, 1)
"""Their strides."""
CHANNELS = (32, 64, 64, 64)
"""Their features, unless others are given."""


class Eyes(NamedTuple):
    """Parameters of the network."""

    convolutions: Any
    """Kernel `[edge, edge, inputs, outputs]` and biases of each convolution; the inputs of the first are the colours
    (or depth) of all cameras, one camera after another."""
    hidden: Any
    """Weights, biases, and scale and offset of the layer normalisation, of each hidden layer."""
    action: Any
    """Weights and biases of the action before tanh."""
    objects: Any
    """Weights and biases of the objects' positions."""


def check_channels(channels: Any) -> None:
    """Raises a ValueError unless `channels` is a tuple of counts, one for each convolution."""
    if not isinstance(channels, tuple) or len(channels) != len(KERNELS):
        raise ValueError(f"channels is {channels!r}; it must be {len(KERNELS)} numbers of features")
    for features in channels:
        check_count("a number of features in channels", features)


def init_eyes(
    rng: jax.Array,
    cameras: int,
    numbers: int,
    channels: Sequence[int],
    hidden: Sequence[int],
    outputs: tuple[int, int],
    colours: int = 3,
) -> Eyes:
    """Returns untrained parameters; the outputs are the sizes of an action and of the objects' positions.

    The `colours` are the numbers of a pixel, 1 for depth.
    """
    rngs = iter(jax.random.split(rng, len(channels) + len(hidden) + 2))

    def scaled(*shape: int, gain: float = 2.0) -> jax.Array:
        fan_in = jnp.prod(jnp.array(shape[:-1]))
        return jax.random.normal(next(rngs), shape) * jnp.sqrt(gain / fan_in)

    convolutions, inputs = [], colours * cameras
    for edge, outs in zip(KERNELS, channels, strict=True):
        convolutions.append((scaled(edge, edge, inputs, outs), jnp.zeros(outs)))
        inputs = outs
    layers, inputs = [], 2 * inputs + numbers
    for width in hidden:
        layers.append((scaled(inputs, width), jnp.zeros(width), jnp.ones(width), jnp.zeros(width)))
        inputs = width
    heads = [(scaled(inputs, size, gain=1e-2), jnp.zeros(size)) for size in outputs]
    return Eyes(convolutions, layers, *heads)


def look(eyes: Eyes, pictures: jax.Array, numbers: jax.Array, dtype: Any = jnp.float32) -> tuple[jax.Array, jax.Array]:
    """Returns actions `[B, action_size]` in [-1, 1], and the objects' positions as the loss has them, `[B, 3 objects]`.

    The pictures are `[B, cameras, H, W, colours]` in [0, 1], the numbers `[B, numbers]` normalised. Convolutions are
    computed in `dtype`.
    """
    preactivation, objects = look_before_tanh(eyes, pictures, numbers, dtype)
    return jnp.tanh(preactivation), objects


def look_before_tanh(
    eyes: Eyes, pictures: jax.Array, numbers: jax.Array, dtype: Any = jnp.float32
) -> tuple[jax.Array, jax.Array]:
    """Returns what `look` does, but the actions before tanh."""
    batch, cameras, height, width, colours = pictures.shape
    seen = jnp.moveaxis(pictures, 1, 3).reshape(batch, height, width, cameras * colours).astype(dtype) - 0.5
    for (kernel, biases), stride in zip(eyes.convolutions, STRIDES, strict=True):
        seen = jax.lax.conv_general_dilated(
            seen, kernel.astype(dtype), (stride, stride), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        seen = jax.nn.relu(seen + biases.astype(dtype))
    hidden = jnp.concatenate([_places(seen.astype(jnp.float32)), numbers], axis=-1)
    for weights, biases, scale, offset in eyes.hidden:
        hidden = hidden @ weights + biases
        centred = hidden - hidden.mean(axis=-1, keepdims=True)
        variance = jnp.square(centred).mean(axis=-1, keepdims=True)
        hidden = jax.nn.relu(centred / jnp.sqrt(variance + NORM_EPSILON) * scale + offset)
    action, objects = (hidden @ weights + biases for weights, biases in (eyes.action, eyes.objects))
    return action, objects


def _places(features: jax.Array) -> jax.Array:
    """Returns the mean place of each feature in the picture, y then x in [-1, 1]: `[B, H, W, C]` to `[B, 2 C]`."""
    batch, height, width, channels = features.shape
    weights = jax.nn.softmax(features.reshape(batch, height * width, channels), axis=1)
    weights = weights.reshape(batch, height, width, channels)
    y = jnp.einsum("bhwc,h->bc", weights, jnp.linspace(-1.0, 1.0, height))
    x = jnp.einsum("bhwc,w->bc", weights, jnp.linspace(-1.0, 1.0, width))
    return jnp.concatenate([y, x], axis=-1)

"""Gradient descent over minibatches, as one scan."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from hgail_envs.workarounds import promotion


def gradient_step(
    optimizer: optax.GradientTransformation,
    params: Any,
    optimizer_state: optax.OptState,
    gradient: Any,
    learning_rate: jax.Array | float,
) -> tuple[Any, optax.OptState]:
    """Returns parameters and the state of an optimiser without a learning rate after one step."""
    with promotion():  # of optax, whose bias correction has a whole number as exponent
        update, optimizer_state = optimizer.update(gradient, optimizer_state)
    scaled = jax.tree.map(lambda leaf: -learning_rate * leaf, update)
    return optax.apply_updates(params, scaled), optimizer_state


def descend(
    optimizer: optax.GradientTransformation,
    loss: Callable[[Any, Any], tuple[jax.Array, Any]],
    params: Any,
    optimizer_state: optax.OptState,
    learning_rate: jax.Array | float,
    minibatches: Any,
) -> tuple[Any, optax.OptState, Any]:
    """Takes one gradient step for each minibatch, leaves `[steps, ...]`.

    The optimiser is without its learning rate, an argument that a sweep can batch. The loss maps parameters and a
    minibatch to a number, `[]`, and metrics. Returns the new parameters, the optimiser's new state and the metrics'
    means over the steps.
    """

    def step(carry: tuple[Any, optax.OptState], minibatch: Any) -> tuple[tuple[Any, optax.OptState], Any]:
        params, optimizer_state = carry
        gradient, metrics = jax.grad(loss, has_aux=True)(params, minibatch)
        return gradient_step(optimizer, params, optimizer_state, gradient, learning_rate), metrics

    (params, optimizer_state), metrics = jax.lax.scan(step, (params, optimizer_state), minibatches)
    return params, optimizer_state, jax.tree.map(jnp.mean, metrics)


def shuffled_minibatches(rng: jax.Array, samples: int, epochs: int, minibatches: int) -> jax.Array:
    """Indices `[epochs * minibatches, B]`: every pass goes through the samples in a new order, less a remainder."""
    size = samples // minibatches
    orders = jax.vmap(lambda rng: jax.random.permutation(rng, samples))(jax.random.split(rng, epochs))
    return orders[:, : size * minibatches].reshape(epochs * minibatches, size)

"""Bare optimiser loop of TD3: its gradient step in plain JAX and optax, a lower bound of what its updates cost.

Below, `U` is the steps of the loop and `B` the samples in one of them.
"""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from hgail_jax.config import Config, Hyperparameters
from hgail_jax.learners import TD3

Layers = list[tuple[jax.Array, ...]]
"""Weights and biases and, of a hidden layer, scale and offset of its layer normalisation."""


class Learnt(NamedTuple):
    """Networks, their targets and optimisers; leaves of `critics` have a leading axis over the critics."""

    actor: Layers
    critics: Layers
    target_actor: Layers
    target_critics: Layers
    moments: tuple[Any, Any]
    """States of Adam, of the actor and of the critics."""


class Batch(NamedTuple):
    """Samples of a step, `[B, ...]`."""

    observation: jax.Array
    action: jax.Array
    next_observation: jax.Array
    reward: jax.Array
    noise: jax.Array
    """Of the target actions, in units of action."""


def bare_optimiser(
    observation_size: int, action_size: int, config: Config, hyper: Hyperparameters, seeds: int
) -> Callable[[], Any]:
    """Returns a function that takes the gradient steps of one update, of all seeds, on random batches.

    XLA has its own options here, not those of the training.

    Args:
      observation_size: numbers in an observation.
      action_size: numbers in an action.
      config: the learner's sizes, and those of its networks, with layer normalisation.
      hyper: of the gradient step.
      seeds: side by side.

    """
    sizes = config.learner
    assert isinstance(sizes, TD3) and config.layer_norm
    rngs = jax.random.split(jax.random.key(0), 3)
    both, hidden = observation_size + action_size, config.policy_hidden
    actor = init_layers(rngs[0], (observation_size, *hidden, action_size))
    critics = jax.vmap(lambda rng: init_layers(rng, (both, *hidden, 1)))(jax.random.split(rngs[1], sizes.critics))
    adam = optax.adam(hyper.policy_learning_rate)
    learnt = Learnt(actor, critics, actor, critics, (adam.init(actor), adam.init(critics)))
    learnt = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (seeds, *leaf.shape)), learnt)
    batches = jax.vmap(lambda rng: random_batches(rng, (sizes.updates, sizes.batch), observation_size, action_size))(
        jax.random.split(rngs[2], seeds)
    )
    loop = jax.jit(jax.vmap(lambda learnt, batches: jax.lax.scan(functools.partial(step, hyper), learnt, batches)))
    return functools.partial(loop.lower(learnt, batches).compile(), learnt, batches)


def random_batches(rng: jax.Array, shape: tuple[int, ...], observation_size: int, action_size: int) -> Batch:
    """Returns samples of `shape` with normal observations."""
    rngs = jax.random.split(rng, 5)
    return Batch(
        observation=jax.random.normal(rngs[0], (*shape, observation_size)),
        action=jax.random.uniform(rngs[1], (*shape, action_size), minval=-1.0),
        next_observation=jax.random.normal(rngs[2], (*shape, observation_size)),
        reward=jax.random.uniform(rngs[3], shape, minval=-1.0, maxval=0.0),
        noise=0.1 * jax.random.normal(rngs[4], (*shape, action_size)),
    )


def init_layers(rng: jax.Array, widths: Sequence[int]) -> Layers:
    """Returns an untrained network from its numbers of inputs, of each hidden layer's and of outputs."""
    layers: Layers = []
    for index, (inputs, outputs) in enumerate(itertools.pairwise(widths)):
        weights = jax.random.normal(jax.random.fold_in(rng, index), (inputs, outputs)) / jnp.sqrt(inputs)
        norm = () if index == len(widths) - 2 else (jnp.ones(outputs), jnp.zeros(outputs))
        layers.append((weights, jnp.zeros(outputs), *norm))
    return layers


def forward(layers: Layers, inputs: jax.Array) -> jax.Array:
    """Runs a network: `[..., inputs]` to `[..., outputs]`."""
    *hidden, (last_weights, last_biases) = layers
    for weights, biases, scale, offset in hidden:
        inputs = inputs @ weights + biases
        centred = inputs - inputs.mean(axis=-1, keepdims=True)
        inputs = centred * jax.lax.rsqrt(jnp.square(centred).mean(axis=-1, keepdims=True) + 1e-6)
        inputs = jax.nn.relu(inputs * scale + offset)
    return inputs @ last_weights + last_biases


def step(hyper: Hyperparameters, learnt: Learnt, batch: Batch) -> tuple[Learnt, jax.Array]:
    """Takes a gradient step of the critics, then of the actor, then of the targets; returns the critics' loss too."""

    def values(critics: Layers, observation: jax.Array, action: jax.Array) -> jax.Array:
        inputs = jnp.concatenate([observation, action], axis=-1)
        return jax.vmap(forward, in_axes=(0, None))(critics, inputs)[..., 0]

    following = jnp.clip(jnp.tanh(forward(learnt.target_actor, batch.next_observation)) + batch.noise, -1.0, 1.0)
    bootstrap = values(learnt.target_critics, batch.next_observation, following).min(axis=0)
    wanted = jnp.clip(batch.reward + hyper.discount * bootstrap, -1.0 / (1.0 - hyper.discount), 0.0)

    def critic_loss(critics: Layers) -> jax.Array:
        return jnp.square(values(critics, batch.observation, batch.action) - wanted).mean(axis=-1).sum()

    def actor_loss(actor: Layers, critics: Layers) -> jax.Array:
        before = forward(actor, batch.observation)
        gained = values(critics, batch.observation, jnp.tanh(before)).mean(axis=0)
        scale = jnp.maximum(jax.lax.stop_gradient(jnp.abs(gained).mean()), 1e-3)
        return -gained.mean() / scale + 0.01 * jnp.square(before).mean()

    of_actor, of_critics = learnt.moments
    adam = optax.adam(hyper.policy_learning_rate)
    loss, gradient = jax.value_and_grad(critic_loss)(learnt.critics)
    change, of_critics = adam.update(gradient, of_critics)
    critics = optax.apply_updates(learnt.critics, change)
    change, of_actor = adam.update(jax.grad(actor_loss)(learnt.actor, critics), of_actor)
    actor = optax.apply_updates(learnt.actor, change)
    follow = functools.partial(optax.incremental_update, step_size=hyper.target_rate)
    after = Learnt(
        actor,
        critics,
        follow(actor, learnt.target_actor),
        follow(critics, learnt.target_critics),
        (of_actor, of_critics),
    )
    return after, loss

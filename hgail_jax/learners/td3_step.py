"""TD3's gradient step: its networks, the targets of the critics, and the losses.

Below, `B` is the samples in one of them.
"""

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct

from hgail_jax.config import Config
from hgail_jax.descent import gradient_step
from hgail_jax.networks import MLP, apply

if TYPE_CHECKING:
    from hgail_jax.learners.td3 import TD3, TD3Hyperparameters

_NOISE_CLIP = 2.5  # in deviations of the target noise, as .5 is to .2 in TD3
PREACTIVATION_WEIGHT = 0.01
"""Weight of the squared action before tanh, which keeps tanh from saturating, where its gradient vanishes."""

Metrics = dict[str, jax.Array]


class Networks(NamedTuple):
    """Parameters of an actor and of an ensemble of critics, whose leaves have a leading axis over the critics."""

    actor: Any
    critics: Any


class TD3State(struct.PyTreeNode):
    """Networks, their targets and optimisers."""

    online: Networks
    target: Networks
    optimizer: Networks
    """States of Adam."""
    steps: jax.Array
    """`[]` integer: gradient steps so far."""


class Batch(NamedTuple):
    """Samples as the networks take them, `[B, ...]`; those of all `U` steps after a roll-out are `[U, B, ...]`.

    Those with a default are of critics that bootstrap.
    """

    observation: jax.Array
    action: jax.Array
    weight: jax.Array
    actor_input: Any
    """Inputs of the actor, leaves `[B, ...]`."""
    next_observation: Any = None
    reward: Any = None
    noise: Any = None
    """Standard normal, for the target actions."""
    next_actor_input: Any = None
    """Its inputs in the next state, under the same goal."""


@dataclasses.dataclass(frozen=True, eq=False)
class GradientStep:
    """A gradient step of critics and actor; called with a state and a minibatch, as `jax.lax.scan` calls it."""

    config: Config
    hyper: "TD3Hyperparameters"

    def __call__(self, state: TD3State, batch: Batch) -> tuple[TD3State, Metrics]:
        """Returns the new state and the step's metrics."""
        hyper, final = self.hyper, cast("TD3", self.config.learner).final_learning_rate
        rate = hyper.policy_learning_rate * (1.0 + (final - 1.0) * progress(self.config, state.steps))
        adam, online, optimizer = optax.scale_by_adam(), state.online, state.optimizer
        (value_loss, value), gradient = jax.value_and_grad(self.critic_loss, has_aux=True)(
            online.critics, state.target, batch
        )
        critics, critics_optimizer = gradient_step(adam, online.critics, optimizer.critics, gradient, rate)
        (policy_loss, metrics), gradient = jax.value_and_grad(self.actor_loss, has_aux=True)(
            online.actor, critics, batch, value
        )
        actor, actor_optimizer = gradient_step(adam, online.actor, optimizer.actor, gradient, rate)
        online = Networks(actor, critics)
        after = state.replace(
            online=online,
            target=jax.tree.map(lambda kept, new: kept + hyper.tau * (new - kept), state.target, online),
            optimizer=Networks(actor_optimizer, critics_optimizer),
            steps=state.steps + 1,
        )
        return after, metrics | {"value_loss": value_loss, "policy_loss": policy_loss, "value": value.mean()}

    def act(self, actor: Any, batch: Batch) -> tuple[jax.Array, jax.Array | float, Metrics]:
        """Returns the actions before tanh, `[B, action_size]`, an auxiliary loss of the actor's, `[]`, and metrics."""
        return apply(actor_network(self.config, batch.action.shape[-1]), actor, batch.actor_input), 0.0, {}

    def act_next(self, actor: Any, batch: Batch) -> jax.Array:
        """Returns the actions before tanh in the next states, `[B, action_size]`."""
        return apply(actor_network(self.config, batch.action.shape[-1]), actor, batch.next_actor_input)

    def target_value(self, target: Networks, batch: Batch) -> jax.Array:
        """Returns the critics' targets, `[B]`: the least of the target critics' values after a noisy target action."""
        noise = self.hyper.target_noise * jnp.clip(batch.noise, -_NOISE_CLIP, _NOISE_CLIP)
        following = jnp.clip(jnp.tanh(self.act_next(target.actor, batch)) + noise, -1.0, 1.0)
        bootstrap = self.values(target.critics, batch.next_observation, following).min(axis=0)
        least = -1.0 / (1.0 - self.hyper.discount)  # the return of -1 at every step for ever, the least of all values
        return jnp.clip(batch.reward + self.hyper.discount * bootstrap, least, 0.0)

    def values(self, critics: Any, observation: jax.Array, action: jax.Array) -> jax.Array:
        """Returns the values of all critics, `[critics, B]`."""
        inputs = jnp.concatenate([observation, action], axis=-1)
        network = critic_network(self.config)
        return jax.vmap(lambda params: apply(network, params, inputs)[..., 0])(critics)

    def critic_loss(self, critics: Any, target: Networks, batch: Batch) -> tuple[jax.Array, jax.Array]:
        """Returns the critics' squared error, `[]`, and their values, `[critics, B]`."""
        value, expected = self.values(critics, batch.observation, batch.action), self.target_value(target, batch)
        return jnp.mean(batch.weight[None] * jnp.square(value - expected[None]), axis=-1).sum(), value

    def actor_loss(self, params: Any, critics: Any, batch: Batch, value: jax.Array) -> tuple[jax.Array, Metrics]:
        """Returns the actor's loss, `[]`, and metrics.

        The loss is the value in units of the mean value, BC where the buffer did better, decay, and the auxiliary loss.
        `value` is the critics' before their step, which saves evaluating them a second time.
        """
        preactivation, auxiliary, metrics = self.act(params, batch)
        action = jnp.tanh(preactivation)
        gained = self.values(critics, batch.observation, action).mean(axis=0)
        loss = -jnp.mean(batch.weight * gained) / jnp.maximum(jax.lax.stop_gradient(jnp.abs(gained).mean()), 1e-3)
        better = jnp.where(value.mean(axis=0) > jax.lax.stop_gradient(gained), batch.weight, 0.0)
        cloning = jnp.mean(better * jnp.square(action - batch.action).sum(axis=-1))
        loss = loss + self.hyper.bc_weight * cloning + PREACTIVATION_WEIGHT * jnp.square(preactivation).mean()
        return loss + auxiliary, metrics


def progress(config: Config, steps: jax.Array) -> jax.Array:
    """Returns the fraction of the run's gradient steps that is done, `[]`."""
    sizes = cast("TD3", config.learner)
    return jnp.minimum(steps / max(config.rounds * sizes.rollouts * sizes.updates, 1), 1.0)


def actor_network(config: Config, action_size: int) -> MLP:
    """Normalised observation to the action before tanh; starts near zero."""
    return MLP(config.policy_hidden, action_size, output_scale=1e-2, layer_norm=config.layer_norm)


def critic_network(config: Config) -> MLP:
    """Normalised observation and action, concatenated, to the expected return, `[..., 1]`."""
    return MLP(config.policy_hidden, 1, layer_norm=config.layer_norm)

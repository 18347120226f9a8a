"""The training state: everything that a round reads and writes, as one pytree."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics, specs
from flax import struct

from envs import GoalEnv
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.experts import init_expert
from hgail_jax.networks import discriminator_network, policy_network, value_network
from hgail_jax.samples import Samples

_MAX_NORMALIZED = 5.0

Params = Any


class TrainState(struct.PyTreeNode):
    """Networks, optimisers, observation statistics, hyperparameters and the PRNG key."""

    actor_critic: Params
    """`{"policy": ..., "value": ...}`."""
    discriminator: Params
    actor_critic_optimizer: optax.OptState
    discriminator_optimizer: optax.OptState
    statistics: running_statistics.RunningStatisticsState
    """Mean and standard deviation of observations so far: the expert samples of the pre-training, and the policy's own
    in its updates."""
    hyperparameters: Hyperparameters
    rng: jax.Array
    expert: Any = None
    """Expert samples that are kept from roll-out to roll-out, see `hgail_jax.experts`; None where none are."""

    def normalize(self, observation: jax.Array) -> jax.Array:
        """Standardises observations, `[..., observation_size]`, and clips them to ±5."""
        return running_statistics.normalize(observation, self.statistics, max_abs_value=_MAX_NORMALIZED)

    def action_std(self, config: Config) -> jax.Array:
        """Returns the policy's standard deviation after the gradient steps so far, `[]` or `[action_size]`."""
        hyper, steps = self.hyperparameters, self.actor_critic_optimizer[-1].count
        return jnp.asarray(hyper.action_std) * annealing(config, hyper.final_action_std)(steps)

    def progress(self, config: Config) -> jax.Array:
        """Returns the share of the rounds that is through, `[]`, by the policy's gradient steps."""
        if not config.policy_phases:  # there are none to tell it by
            return jnp.ones(())
        return 1.0 - annealing(config, 0.0)(self.actor_critic_optimizer[-1].count)

    def observe(self, observation: jax.Array, weight: jax.Array) -> "TrainState":
        """Counts observations, `[S, observation_size]` into the statistics by `weight`, `[S]`.

        Where observations are not to be standardised the statistics stay at mean 0 and standard deviation 1.
        """
        counted = running_statistics.update(self.statistics, observation, weights=weight)
        kept = functools.partial(jnp.where, self.hyperparameters.standardize_observation)
        return self.replace(statistics=jax.tree.map(kept, counted, self.statistics))


class StateKeys(NamedTuple):
    """What the key of a training state is split into. All come from one split, so that no two of them ever meet."""

    following: jax.Array
    """Of the state after a phase that learns."""
    phase: jax.Array
    """Of that phase: its roll-out and its update."""
    evaluation: jax.Array
    """Of an evaluation between two phases."""
    final_evaluation: jax.Array
    """Of an evaluation once the training is over."""


def split_key(rng: jax.Array) -> StateKeys:
    """Splits the key of a training state.

    Deriving one of these by `jax.random.fold_in(rng, 1)` would not do: that is bit for bit the second half of
    `jax.random.split(rng)`, and evaluations would play the starts and goals of the next phase.
    """
    return StateKeys(*jax.random.split(rng, len(StateKeys._fields)))


def actor_critic_optimizer(config: Config) -> optax.GradientTransformation:
    """Adam for policy and value function, less the learning rate, which is a hyperparameter of the state."""
    return optax.chain(optax.scale_by_adam(), optax.scale_by_schedule(annealing(config, config.final_learning_rate)))


def annealing(config: Config, final: jax.Array | float) -> optax.Schedule:
    """Returns a factor by the gradient steps of the policy: 1 through the pre-training, then linear to `final`."""
    pretraining = config.pretrain_policy_minibatches if config.pretrain else 0
    rounds = config.rounds * config.policy_phases * config.ppo_epochs * config.ppo_minibatches
    return optax.linear_schedule(1.0, final, rounds, transition_begin=pretraining)


def discriminator_optimizer() -> optax.GradientTransformation:
    """Adam for the discriminator, less the learning rate."""
    return optax.scale_by_adam()


def init_state(
    env: GoalEnv,
    config: Config,
    hyperparameters: Hyperparameters,
    rng: jax.Array,
    demonstrations: Samples | None = None,
) -> TrainState:
    """Returns the state of an untrained learner; `jax.vmap` it over `rng` for several seeds.

    Args:
      env: the task.
      config: sizes and counts.
      hyperparameters: scalars, or tracers where a sweep is vmapped.
      rng: a PRNG key, from `jax.random.key`.
      demonstrations: leaves `[S, ...]`; where the config's expert samples are demonstrations, and only there.

    Raises:
      ValueError: see `Config.validate`, `Hyperparameters.validate` and `init_expert`; or there are several standard
        deviations, but not one for each number of an action.

    """
    config.validate(env)
    hyperparameters.validate(env.action_size)
    policy_rng, value_rng, discriminator_rng, rng = jax.random.split(rng, 4)
    observation = jnp.zeros(env.observation_size)
    actor_critic = {
        "policy": policy_network(config, env.action_size).init(policy_rng, observation),
        "value": value_network(config).init(value_rng, observation),
    }
    observation_and_action = jnp.zeros(env.observation_size + env.action_size)
    discriminator = discriminator_network(config).init(discriminator_rng, observation_and_action)
    return TrainState(
        actor_critic=actor_critic,
        discriminator=discriminator,
        actor_critic_optimizer=actor_critic_optimizer(config).init(actor_critic),
        discriminator_optimizer=discriminator_optimizer().init(discriminator),
        statistics=running_statistics.init_state(specs.Array((env.observation_size,), jnp.dtype("float32"))),
        hyperparameters=Hyperparameters(**{name: jnp.asarray(value) for name, value in vars(hyperparameters).items()}),
        rng=rng,
        expert=init_expert(env, config, demonstrations),
    )

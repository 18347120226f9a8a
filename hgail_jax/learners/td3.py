"""The off-policy learner: actor and critics trained on a replay buffer, each sample used many times.

It is TD3 (Fujimoto et al. 2018) with hindsight: every time a sample is drawn its goal is drawn anew, and its reward is
computed for that goal. Below, `U` is the gradient steps after a roll-out and `B` the samples in one of them.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from hgail_envs import GoalEnv
from hgail_envs.validation import check_count, check_fraction, check_not_negative
from hgail_jax.buffer import (
    EpisodeBuffer,
    ReplayHyperparameters,
    add_episodes,
    draw,
    draw_detour,
    draw_negatives,
    draw_positives,
    init_buffer,
)
from hgail_jax.config import RELABELLED, Config, Hyperparameters
from hgail_jax.descent import gradient_step
from hgail_jax.devices.sharding import local_shard
from hgail_jax.discriminator import bounded_reward, fit_discriminator
from hgail_jax.experts import expert_samples
from hgail_jax.learner import EVALUATE, POLICY, PRETRAIN, SKIP, Learner, Phase, Update, check_sizes
from hgail_jax.networks import MLP, apply, dense_layers
from hgail_jax.rollout import Detour, Policy, Trajectory
from hgail_jax.samples import policy_samples
from hgail_jax.state import TrainState

_NOISE_CLIP = 2.5  # in deviations of the target noise, as .5 is to .2 in TD3
_PREACTIVATION_WEIGHT = 0.01  # keeps tanh from saturating, where its gradient vanishes

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


class TD3Hyperparameters(ReplayHyperparameters):
    """Hyperparameters of TD3."""

    fractions: ClassVar[tuple[str, ...]] = (*ReplayHyperparameters.fractions, "epsilon", "tau")
    not_negative: ClassVar[tuple[str, ...]] = (*ReplayHyperparameters.not_negative, "target_noise")

    epsilon: jax.Array | float = 0.3
    """Probability of a uniformly random action in a step of a roll-out to learn from."""
    tau: jax.Array | float = 0.01
    """Rate τ at which target networks follow the networks."""
    target_noise: jax.Array | float = 0.2
    """Standard deviation of the noise on target actions, which is clipped at 2.5 of it."""


@dataclasses.dataclass(frozen=True)
class TD3(Learner):
    """TD3 without its delay of the actor, on samples relabelled in hindsight.

    A value out of its range is a ValueError.
    """

    name: ClassVar[str] = "td3"
    metrics: ClassVar[Mapping[str, str]] = {
        "reward": "mean reward of the samples drawn",
        "reached": "fraction of the samples drawn whose next state is at their goal",
        "value": "mean value of the critics",
        "value_loss": "mean squared error of the critics",
        "policy_loss": "loss of the actor",
        "discriminator_loss": "cross-entropy of the discriminator, 2 log 2 at chance",
        "discriminator_accuracy": "fraction of samples that the discriminator classifies correctly",
    }
    hyperparameters: ClassVar[type[Hyperparameters]] = TD3Hyperparameters
    without_effect: ClassVar[tuple[str, ...]] = ("pretrain", "reward", "standardize_reward")
    squashes: ClassVar[bool] = True

    rollouts: int = 5
    """Roll-outs in a round, each followed by `updates`."""
    updates: int = 256
    """Gradient steps of actor and critics after each roll-out."""
    batch: int = 1024
    """Samples in one of them."""
    buffer_episodes: int = 8192
    """Episodes in the replay buffer."""
    critics: int = 2
    """Critics in the ensemble; targets bootstrap from the least of their values."""
    final_learning_rate: float = 1.0
    """Learning rate of actor and critics at the end of the last round, as a fraction of its start."""
    final_discriminator_learning_rate: float = 1.0
    """The discriminator's, likewise."""
    achieved_first: float = 0.0
    """Fraction of the episodes to learn from that begin with a goal that an earlier one achieved."""
    gradient_penalty: float = 0.0
    """Weight of the discriminator's gradient penalty, see `hgail_jax.discriminator.gradient_penalty`."""

    def __post_init__(self) -> None:
        check_sizes(self)
        for name in ("final_learning_rate", "final_discriminator_learning_rate", "achieved_first"):
            check_fraction(name, getattr(self, name))
        check_not_negative("gradient_penalty", self.gradient_penalty)

    def validate(self, env: GoalEnv, config: Config) -> None:
        """See `Learner`; a roll-out must fit into the buffer."""
        check_count("num_envs, within buffer_episodes (--settings),", config.num_envs, most=self.buffer_episodes)

    def check_hyperparameters(self, config: Config, hyper: Hyperparameters) -> None:
        """See `Learner`; the discriminator is trained if it has a say in the reward, and only then."""
        alone = np.all(np.asarray(hyper.environment_reward) == 1.0)
        if alone and config.discriminator_minibatches:
            raise ValueError("environment_reward is 1, with which the discriminator has no say: that is the method her")
        if not (alone or config.discriminator_minibatches):
            raise ValueError(
                f"environment_reward is {hyper.environment_reward}; without discriminator_minibatches it must be 1"
            )

    def init(self, env: GoalEnv, config: Config, rngs: jax.Array) -> TD3State:
        """See `Learner`."""
        observation, both = jnp.zeros(env.observation_size), jnp.zeros(env.observation_size + env.action_size)
        rngs_of_critics = jax.random.split(rngs[1], self.critics)
        networks = Networks(
            actor=_actor_network(config, env.action_size).init(rngs[0], observation),
            critics=jax.vmap(lambda rng: _critic_network(config).init(rng, both))(rngs_of_critics),
        )
        optimizer = Networks(*(optax.scale_by_adam().init(params) for params in networks))
        return TD3State(networks, networks, optimizer, jnp.zeros((), jnp.int32))

    def init_buffer(self, env: GoalEnv) -> EpisodeBuffer:
        """See `Learner`."""
        return init_buffer(env, self.buffer_episodes)

    def phase_updates(self) -> Mapping[Phase, Update]:
        """See `Learner`; the first phase fills the buffer."""
        return {PRETRAIN: self.begin, POLICY: self.update}

    def policy(
        self, env: GoalEnv, config: Config, state: TrainState, noise: jax.Array | float, axis: str | None = None
    ) -> Policy:
        """See `Learner`; noise is Gaussian, and some actions are uniformly random, all of them before any update.

        The target actor acts, in roll-outs, in evaluations and in the exported policy: it is an average over the last
        1 / tau gradient steps, and steadier than the actor.
        """
        hyper = cast(TD3Hyperparameters, state.hyperparameters)
        decay = 1.0 + (hyper.final_exploration_noise - 1.0) * self.progress(config, state)
        std = noise * decay * jnp.asarray(hyper.exploration_noise)
        random = noise * jnp.where(state.learner.steps > 0, decay * hyper.epsilon, 1.0)
        network = _actor_network(config, env.action_size)

        def policy(observation: jax.Array, rng: jax.Array) -> tuple[jax.Array, jax.Array]:
            mean = jnp.tanh(apply(network, state.learner.target.actor, state.normalize(observation)))
            count = len(mean) * (1 if axis is None else jax.lax.axis_size(axis))
            noise_rng, uniform_rng, choice_rng = jax.random.split(rng, 3)
            gaussian = local_shard(jax.random.normal(noise_rng, (count, env.action_size)), axis)
            uniform = local_shard(jax.random.uniform(uniform_rng, (count, env.action_size), minval=-1.0), axis)
            chosen = local_shard(jax.random.bernoulli(choice_rng, random, (count, 1)), axis)
            return jnp.where(chosen, uniform, jnp.clip(mean + std * gaussian, -1.0, 1.0)), jnp.zeros(len(mean))

        return policy

    def detour(self, env: GoalEnv, config: Config, state: TrainState, rng: jax.Array) -> Detour | None:
        """See `Learner`; a fraction `achieved_first` of the episodes has one."""
        share = self.achieved_first
        return draw_detour(env, state.buffer, rng, config.num_envs, share) if share else None

    def progress(self, config: Config, state: TrainState) -> jax.Array:
        """See `Learner`; from the count of gradient steps."""
        return _progress(config, self, state.learner.steps)

    def phase_table(self, config: Config) -> np.ndarray:
        """See `Learner`; row 0 fills the buffer with random actions."""
        first = [PRETRAIN] + [SKIP] * (self.rollouts - 1) + [EVALUATE]
        return np.array([first] + [[POLICY] * self.rollouts + [EVALUATE]] * config.rounds)

    def layers(self, state: TrainState) -> list[tuple[jax.Array, ...]]:
        """See `Learner`."""
        return dense_layers(state.learner.target.actor)

    def begin(
        self, env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """Adds the first roll-out to the buffer, and to the expert samples where those are kept."""
        state = _fill(env, state, trajectory)
        if config.expert_source != RELABELLED:
            expert, _ = expert_samples(env, config, state.hyperparameters, state.expert, trajectory, rng)
            state = state.replace(expert=expert)
        return state, {}

    def update(
        self, env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """Adds a roll-out to the buffer, then trains discriminator, critics and actor on samples of all of it."""
        discriminator_rng, draw_rng, noise_rng = jax.random.split(rng, 3)
        hyper = cast(TD3Hyperparameters, state.hyperparameters)
        state = _fill(env, state, trajectory)
        state, metrics = _update_discriminator(env, config, state, trajectory, discriminator_rng)
        drawn = draw(env, hyper, state.buffer, draw_rng, self.updates * self.batch, hyper.p_ht)
        batch = _Batch(
            observation=state.normalize(drawn.observation),
            action=drawn.action,
            next_observation=state.normalize(drawn.next_observation),
            reward=bounded_reward(config, state, drawn.observation, drawn.action, drawn.reached),
            weight=drawn.weight,
            noise=jax.random.normal(noise_rng, drawn.action.shape),
        )
        minibatches = jax.tree.map(lambda leaf: leaf.reshape(self.updates, self.batch, *leaf.shape[1:]), batch)
        networks = _actor_network(config, env.action_size), _critic_network(config)
        step = _Step(config, self, hyper, *networks)
        learner, measured = jax.lax.scan(step, state.learner, minibatches)
        metrics |= {name: values.mean() for name, values in measured.items()}
        metrics |= {"reward": batch.reward.mean(), "reached": drawn.reached.mean()}
        return state.replace(learner=learner), metrics


def _fill(env: GoalEnv, state: TrainState, trajectory: Trajectory) -> TrainState:
    """Adds a roll-out to the buffer and to the statistics of observations."""
    state = state.count(policy_samples(env, trajectory))
    return state.replace(buffer=add_episodes(state.buffer, trajectory))


class _Batch(NamedTuple):
    """Samples as the networks take them, `[B, ...]`, or `[U, B, ...]` those of all steps after a roll-out."""

    observation: jax.Array
    action: jax.Array
    next_observation: jax.Array
    reward: jax.Array
    weight: jax.Array
    noise: jax.Array
    """Standard normal, for the target actions."""


def _update_discriminator(
    env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
) -> tuple[TrainState, Metrics]:
    """Trains the discriminator on expert samples against the buffer's."""
    if not (count := config.discriminator_minibatches):
        return state, {}
    expert_rng, policy_rng, fit_rng, jitter_rng, shuffle_rng = jax.random.split(rng, 5)
    hyper, sizes = cast(TD3Hyperparameters, state.hyperparameters), cast(TD3, config.learner)
    samples = count * config.discriminator_batch
    if config.expert_source == RELABELLED:
        expert = draw_positives(env, hyper, state.buffer, samples, expert_rng, jitter_rng)
    else:
        kept, expert = expert_samples(env, config, hyper, state.expert, trajectory, expert_rng)
        state = state.replace(expert=kept)
    policy = draw_negatives(env, hyper, state.buffer, samples, policy_rng, shuffle_rng)
    decay = 1.0 + (sizes.final_discriminator_learning_rate - 1.0) * sizes.progress(config, state)
    return fit_discriminator(config, state, expert, policy, count, fit_rng, decay, sizes.gradient_penalty)


@dataclasses.dataclass(frozen=True, eq=False)
class _Step:
    """A gradient step of critics and actor; called with a state and a minibatch, as `jax.lax.scan` calls it."""

    config: Config
    sizes: TD3
    hyper: TD3Hyperparameters
    actor: MLP
    critic: MLP

    def __call__(self, state: TD3State, batch: _Batch) -> tuple[TD3State, Metrics]:
        """Returns the new state and the step's metrics."""
        hyper, final = self.hyper, self.sizes.final_learning_rate
        rate = hyper.policy_learning_rate * (1.0 + (final - 1.0) * _progress(self.config, self.sizes, state.steps))
        target = self.target_value(state.target, batch)
        adam, online, optimizer = optax.scale_by_adam(), state.online, state.optimizer
        (value_loss, value), gradient = jax.value_and_grad(self.critic_loss, has_aux=True)(
            online.critics, batch, target
        )
        critics, critics_optimizer = gradient_step(adam, online.critics, optimizer.critics, gradient, rate)
        policy_loss, gradient = jax.value_and_grad(self.actor_loss)(online.actor, critics, batch, value)
        actor, actor_optimizer = gradient_step(adam, online.actor, optimizer.actor, gradient, rate)
        online = Networks(actor, critics)
        after = TD3State(
            online=online,
            target=jax.tree.map(lambda kept, new: kept + hyper.tau * (new - kept), state.target, online),
            optimizer=Networks(actor_optimizer, critics_optimizer),
            steps=state.steps + 1,
        )
        return after, {"value_loss": value_loss, "policy_loss": policy_loss, "value": value.mean()}

    def target_value(self, target: Networks, batch: _Batch) -> jax.Array:
        """Returns the critics' targets, `[B]`: the least of the target critics' values after a noisy target action."""
        noise = self.hyper.target_noise * jnp.clip(batch.noise, -_NOISE_CLIP, _NOISE_CLIP)
        following = jnp.tanh(apply(self.actor, target.actor, batch.next_observation))
        following = jnp.clip(following + noise, -1.0, 1.0)
        bootstrap = self.values(target.critics, batch.next_observation, following).min(axis=0)
        least = -1.0 / (1.0 - self.hyper.discount)  # the return of -1 at every step for ever, the least of all values
        return jnp.clip(batch.reward + self.hyper.discount * bootstrap, least, 0.0)

    def values(self, critics: Any, observation: jax.Array, action: jax.Array) -> jax.Array:
        """Returns the values of all critics, `[critics, B]`."""
        inputs = jnp.concatenate([observation, action], axis=-1)
        return jax.vmap(lambda params: apply(self.critic, params, inputs)[..., 0])(critics)

    def critic_loss(self, critics: Any, batch: _Batch, target: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the critics' squared error, `[]`, and their values, `[critics, B]`."""
        value = self.values(critics, batch.observation, batch.action)
        return jnp.mean(batch.weight[None] * jnp.square(value - target[None]), axis=-1).sum(), value

    def actor_loss(self, params: Any, critics: Any, batch: _Batch, value: jax.Array) -> jax.Array:
        """Returns the actor's loss, `[]`: its value in units of the mean value, BC where the buffer did better, decay.

        `value` is the critics' before their step, which saves evaluating them a second time.
        """
        preactivation = apply(self.actor, params, batch.observation)
        action = jnp.tanh(preactivation)
        gained = self.values(critics, batch.observation, action).mean(axis=0)
        loss = -jnp.mean(batch.weight * gained) / jnp.maximum(jax.lax.stop_gradient(jnp.abs(gained).mean()), 1e-3)
        better = jnp.where(value.mean(axis=0) > jax.lax.stop_gradient(gained), batch.weight, 0.0)
        cloning = jnp.mean(better * jnp.square(action - batch.action).sum(axis=-1))
        return loss + self.hyper.bc_weight * cloning + _PREACTIVATION_WEIGHT * jnp.square(preactivation).mean()


def _progress(config: Config, sizes: TD3, steps: jax.Array) -> jax.Array:
    """Returns the fraction of the run's gradient steps that is done, `[]`."""
    return jnp.minimum(steps / max(config.rounds * sizes.rollouts * sizes.updates, 1), 1.0)


def _actor_network(config: Config, action_size: int) -> MLP:
    """Normalised observation to the action before tanh; starts near zero."""
    return MLP(config.policy_hidden, action_size, output_scale=1e-2, layer_norm=config.layer_norm)


def _critic_network(config: Config) -> MLP:
    """Normalised observation and action, concatenated, to the expected return, `[..., 1]`."""
    return MLP(config.policy_hidden, 1, layer_norm=config.layer_norm)

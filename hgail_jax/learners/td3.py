"""The off-policy learner: actor and critics trained on a replay buffer, each sample used many times.

It is TD3 (Fujimoto et al. 2018) with hindsight: every time a sample is drawn its goal is drawn anew, and its reward is
computed for that goal. Below, `U` is the gradient steps after a roll-out and `B` the samples in one of them.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, ClassVar, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax

from hgail_envs import GoalEnv
from hgail_envs.validation import check_count, check_fraction, check_not_negative
from hgail_jax.buffer import (
    EpisodeBuffer,
    ReplayHyperparameters,
    Transitions,
    add_episodes,
    draw,
    draw_detour,
    draw_negatives,
    draw_positives,
    init_buffer,
)
from hgail_jax.config import RELABELLED, Config, Hyperparameters
from hgail_jax.devices.sharding import local_shard
from hgail_jax.discriminator import bounded_reward, fit_discriminator
from hgail_jax.experts import expert_samples
from hgail_jax.learner import EVALUATE, POLICY, PRETRAIN, SKIP, Learner, Phase, Update, check_sizes
from hgail_jax.learners.td3_step import (
    Batch,
    GradientStep,
    Metrics,
    Networks,
    TD3State,
    actor_network,
    critic_network,
    progress,
)
from hgail_jax.networks import apply, dense_layers
from hgail_jax.rollout import Detour, Policy, Trajectory
from hgail_jax.samples import policy_samples
from hgail_jax.state import TrainState


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
        init_critic = functools.partial(self.init_critic, env, config)
        networks = Networks(
            actor=actor_network(config, env.action_size).init(rngs[0], jnp.zeros(env.goal_observation_size)),
            critics=jax.vmap(init_critic)(jax.random.split(rngs[1], self.critics)),
        )
        optimizer = Networks(*(optax.scale_by_adam().init(params) for params in networks))
        return TD3State(networks, networks, optimizer, jnp.zeros((), jnp.int32))

    def init_critic(self, env: GoalEnv, config: Config, rng: jax.Array) -> Any:
        """Returns the untrained parameters of one critic of the ensemble."""
        return critic_network(config).init(rng, jnp.zeros(env.goal_observation_size + env.action_size))

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

        def policy(observation: jax.Array, rng: jax.Array) -> tuple[jax.Array, Any]:
            mean, noted = self.act(env, config, state, observation)
            count = len(mean) * (1 if axis is None else jax.lax.axis_size(axis))
            noise_rng, uniform_rng, choice_rng = jax.random.split(rng, 3)
            gaussian = local_shard(jax.random.normal(noise_rng, (count, env.action_size)), axis)
            uniform = local_shard(jax.random.uniform(uniform_rng, (count, env.action_size), minval=-1.0), axis)
            chosen = local_shard(jax.random.bernoulli(choice_rng, random, (count, 1)), axis)
            return jnp.where(chosen, uniform, jnp.clip(mean + std * gaussian, -1.0, 1.0)), noted

        return policy

    def act(self, env: GoalEnv, config: Config, state: TrainState, observation: jax.Array) -> tuple[jax.Array, Any]:
        """Returns the target actor's actions for observations, `[N, ...]`, and what the roll-out is to note."""
        network = actor_network(config, env.action_size)
        mean = jnp.tanh(apply(network, state.learner.target.actor, state.normalize(observation)))
        return mean, jnp.zeros(len(mean))

    def detour(self, env: GoalEnv, config: Config, state: TrainState, rng: jax.Array) -> Detour | None:
        """See `Learner`; a fraction `achieved_first` of the episodes has one."""
        share = self.achieved_first
        return draw_detour(env, state.buffer, rng, config.num_envs, share) if share else None

    def progress(self, config: Config, state: TrainState) -> jax.Array:
        """See `Learner`; from the count of gradient steps."""
        return progress(config, state.learner.steps)

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
        state = fill_buffer(env, state, trajectory)
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
        state = fill_buffer(env, state, trajectory)
        state, metrics = _update_discriminator(env, config, state, trajectory, discriminator_rng)
        drawn = draw(env, hyper, state.buffer, draw_rng, self.updates * self.batch, hyper.p_ht)
        actor_input, next_actor_input = self.actor_inputs(env, state, drawn)
        batch = Batch(
            observation=state.normalize(drawn.observation),
            action=drawn.action,
            next_observation=state.normalize(drawn.next_observation),
            reward=bounded_reward(config, state, drawn.observation, drawn.action, drawn.reached),
            weight=drawn.weight,
            noise=jax.random.normal(noise_rng, drawn.action.shape),
            actor_input=actor_input,
            next_actor_input=next_actor_input,
        )
        minibatches = jax.tree.map(lambda leaf: leaf.reshape(self.updates, self.batch, *leaf.shape[1:]), batch)
        learner, measured = self.fit(env, config, state, minibatches, noise_rng)
        metrics |= {name: values.mean() for name, values in measured.items()}
        metrics |= {"reward": batch.reward.mean(), "reached": drawn.reached.mean()}
        return state.replace(learner=learner), metrics

    def actor_inputs(self, env: GoalEnv, state: TrainState, drawn: Transitions) -> tuple[Any, Any]:
        """Returns what the actor observes of samples, and in their next states; here what the critics do."""
        return state.normalize(drawn.observation), state.normalize(drawn.next_observation)

    def fit(
        self, env: GoalEnv, config: Config, state: TrainState, minibatches: Batch, rng: jax.Array
    ) -> tuple[TD3State, Metrics]:
        """Takes a gradient step for each minibatch, `[U, B, ...]`; returns the learner and the metrics, `[U]` each.

        The key `rng` also drew the minibatches' noise.
        """
        step = GradientStep(config, cast(TD3Hyperparameters, state.hyperparameters))
        return jax.lax.scan(step, state.learner, minibatches)


def fill_buffer(env: GoalEnv, state: TrainState, trajectory: Trajectory) -> TrainState:
    """Adds a roll-out to the buffer and to the statistics of observations."""
    state = state.count(policy_samples(env, trajectory))
    return state.replace(buffer=add_episodes(state.buffer, trajectory))


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

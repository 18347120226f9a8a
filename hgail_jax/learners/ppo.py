"""The paper's learner: PPO under the discriminator's reward, each roll-out used once.

Below, `S` is a number of samples (of a whole roll-out, steps × episodes), and `B` the size of a minibatch.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from hgail_envs import GoalEnv
from hgail_envs.validation import check_count, check_fraction
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.descent import descend, shuffled_minibatches
from hgail_jax.devices.sharding import local_shard
from hgail_jax.discriminator import discriminate, fit_discriminator, imitation_reward
from hgail_jax.experts import expert_samples
from hgail_jax.learner import DISCRIMINATOR, EVALUATE, POLICY, PRETRAIN, SKIP, Learner, Phase, Update, check_sizes
from hgail_jax.learners.ppo_loss import generalized_advantages, policy_loss, standardize, weighted_mean
from hgail_jax.networks import MLP, apply, dense_layers, gaussian_log_prob
from hgail_jax.rollout import Policy, Trajectory
from hgail_jax.samples import Samples, flatten, negative_samples, policy_samples, step_weight
from hgail_jax.state import TrainState

Metrics = dict[str, jax.Array]

BC_BATCH = 512
"""Expert samples of the BC loss beside a minibatch of PPO, where it is asked for without a number."""


class PPOState(struct.PyTreeNode):
    """Networks and optimiser of PPO."""

    actor_critic: Any
    """`{"policy": ..., "value": ...}`."""
    optimizer: optax.OptState


@dataclasses.dataclass(frozen=True)
class PPO(Learner):
    """PPO (Schulman et al. 2017) with a value function, and behaviour cloning (BC) of the expert samples.

    A value out of its range is a ValueError.
    """

    name: ClassVar[str] = "ppo"
    metrics: ClassVar[Mapping[str, str]] = {
        "reward": "mean reward that the policy was given",
        "policy_loss": "PPO's clipped loss",
        "value_loss": "half the squared error of the value function",
        "clip_fraction": "fraction of samples whose probability ratio is outside the bounds",
        "kl": "estimate of KL(old policy ‖ new policy), nats",
        "bc_loss": "mean negative log-likelihood of expert samples, nats",
        "discriminator_loss": "cross-entropy of the discriminator, 2 log 2 at chance",
        "discriminator_accuracy": "fraction of samples that the discriminator classifies correctly",
    }
    hyperparameters: ClassVar[type[Hyperparameters]] = Hyperparameters

    pretrain: bool = True
    """Whether to pre-train policy and discriminator before the first round."""
    policy_phases: int = 3
    """Roll-outs with a PPO update in a round (the paper's g_steps)."""
    discriminator_phases: int = 3
    """Roll-outs with a discriminator update in a round (the paper's d_steps)."""
    epochs: int = 2
    """Passes over the samples of a roll-out in one PPO update."""
    minibatches: int = 4
    """Minibatches that a roll-out is cut into in one pass."""
    bc_batch: int = 0
    """Expert samples of the BC loss beside each minibatch of PPO; 0 leaves it to the pre-training."""
    pretrain_policy_minibatches: int = 300
    """Gradient steps of behaviour cloning in the pre-training."""
    pretrain_policy_batch: int = 512
    """Samples in one of them."""
    pretrain_discriminator_minibatches: int = 500
    """Gradient steps of the discriminator in the pre-training."""
    final_learning_rate: float = 0.0
    """Policy's learning rate at the end of the last round, as a fraction of its start; it shrinks linearly."""

    def __post_init__(self) -> None:
        check_sizes(self, may_be_zero=("policy_phases", "discriminator_phases", "bc_batch"))
        check_fraction("final_learning_rate", self.final_learning_rate)

    def validate(self, env: GoalEnv, config: Config) -> None:
        """See `Learner`; a minibatch needs a sample, and the discriminator an update."""
        check_count("minibatches", self.minibatches, most=config.num_envs * env.episode_length)
        check_count("discriminator_minibatches", config.discriminator_minibatches)

    def with_bc(self, weight: float) -> "PPO":
        """See `Learner`; a weight of 0 leaves the BC loss out of the program."""
        return dataclasses.replace(self, bc_batch=(self.bc_batch or BC_BATCH) if weight else 0)

    def init(self, env: GoalEnv, config: Config, rngs: jax.Array) -> PPOState:
        observation = jnp.zeros(env.observation_size)
        policy_rng, value_rng = rngs
        actor_critic = {
            "policy": _policy_network(config, env.action_size).init(policy_rng, observation),
            "value": _value_network(config).init(value_rng, observation),
        }
        return PPOState(actor_critic, self.optimizer(config).init(actor_critic))

    def phase_updates(self) -> Mapping[Phase, Update]:
        """See `Learner`."""
        return {PRETRAIN: self.fit_to_first, POLICY: self.update_policy, DISCRIMINATOR: self.update_discriminator}

    def policy(
        self, env: GoalEnv, config: Config, state: TrainState, noise: jax.Array | float, axis: str | None = None
    ) -> Policy:
        """See `Learner`; the action is Gaussian, without noise its mean."""
        std = self.policy_std(config, state)
        network = _policy_network(config, env.action_size)

        def policy(observation: jax.Array, rng: jax.Array) -> tuple[jax.Array, jax.Array]:
            mean = apply(network, state.learner.actor_critic["policy"], state.normalize(observation))
            of_all = mean.shape if axis is None else (len(mean) * jax.lax.axis_size(axis), env.action_size)
            spread = noise * jnp.broadcast_to(std, mean.shape)
            action = mean + spread * local_shard(jax.random.normal(rng, of_all), axis)
            return action, gaussian_log_prob(action, mean, std)

        return policy

    def progress(self, config: Config, state: TrainState) -> jax.Array:
        """See `Learner`; from the optimiser's step count."""
        if not self.policy_phases:  # there are no steps to count
            return jnp.ones(())
        return 1.0 - self.decay_schedule(config, 0.0)(state.learner.optimizer[-1].count)

    def phase_table(self, config: Config) -> np.ndarray:
        """See `Learner`; row 0 is the pre-training, if there is one."""
        updates = [POLICY] * self.policy_phases + [DISCRIMINATOR] * self.discriminator_phases
        first = [PRETRAIN if self.pretrain else SKIP] + [SKIP] * len(updates) + [EVALUATE]
        return np.array([first] + [[SKIP, *updates, EVALUATE]] * config.rounds)

    def layers(self, state: TrainState) -> list[tuple[jax.Array, ...]]:
        return dense_layers(state.learner.actor_critic["policy"])

    def decay_schedule(self, config: Config, final: jax.Array | float) -> optax.Schedule:
        """Returns a factor by the policy's gradient steps: 1 through the pre-training, then linear to `final`.

        The learning rate falls by it, and so does the policy's standard deviation.
        """
        pretraining = self.pretrain_policy_minibatches if self.pretrain else 0
        rounds = config.rounds * self.policy_phases * self.epochs * self.minibatches
        return optax.linear_schedule(1.0, final, rounds, transition_begin=pretraining)

    def optimizer(self, config: Config) -> optax.GradientTransformation:
        """Returns Adam for policy and value function, without the learning rate, a hyperparameter of the state."""
        decay = self.decay_schedule(config, self.final_learning_rate)
        return optax.chain(optax.scale_by_adam(), optax.scale_by_schedule(decay))

    def policy_std(self, config: Config, state: TrainState) -> jax.Array:
        """Returns the policy's standard deviation after the gradient steps so far, `[]` or `[action_size]`."""
        hyper, count = state.hyperparameters, state.learner.optimizer[-1].count
        return jnp.asarray(hyper.exploration_noise) * self.decay_schedule(config, hyper.final_exploration_noise)(count)

    def fit_to_first(
        self, env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """Pre-trains policy and discriminator on the first roll-out (Algorithm 2, lines 1 to 3).

        The policy by BC of the expert samples, the discriminator by cross-entropy of these against the roll-out as it
        was.
        """
        relabel_rng, policy_rng, discriminator_rng = jax.random.split(rng, 3)
        before, (state, expert) = state, _expert_samples(env, config, state, trajectory, relabel_rng)
        # Moving the normaliser shifts the policy's inputs and so undoes the cloning; started on the cloned samples it
        # moves less than if it began with the roll-out's own.
        state = state.count(expert)
        bc_loss = _bc_loss(env, config, state, expert, self.policy_std(config, state))

        def loss(params: Any, indices: jax.Array) -> tuple[jax.Array, Metrics]:
            value = bc_loss(params, indices)
            return value, {"bc_loss": value}

        shape = (self.pretrain_policy_minibatches, self.pretrain_policy_batch)
        state, cloning = self.descend(config, state, loss, expert.draw(policy_rng, shape))
        again = jax.random.clone(relabel_rng)  # the same goals
        jittered = _expert_samples(env, config, before, trajectory, again, state.hyperparameters.goal_jitter)[1]
        policy = negative_samples(env, state.hyperparameters, trajectory, jax.random.fold_in(rng, 3))
        minibatches = self.pretrain_discriminator_minibatches
        state, metrics = fit_discriminator(config, state, jittered, policy, minibatches, discriminator_rng)
        return state, cloning | metrics

    def update_discriminator(
        self, env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """Trains the discriminator on expert samples against a roll-out's own (Algorithm 2, the d_steps)."""
        (relabel_rng, fit_rng), hyper = jax.random.split(rng), state.hyperparameters
        state, expert = _expert_samples(env, config, state, trajectory, relabel_rng, hyper.goal_jitter)
        policy = negative_samples(env, hyper, trajectory, jax.random.fold_in(rng, 2))
        # The statistics stay: they are the policy's input too, which this phase must not change.
        return fit_discriminator(config, state, expert, policy, config.discriminator_minibatches, fit_rng)

    def update_policy(
        self, env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """Improves the policy by PPO under the discriminator's reward (Algorithm 2, the g_steps).

        With a `bc_batch` each gradient also follows the BC loss of that many expert samples.
        """
        hyper = state.hyperparameters
        relabel_rng, draw_rng, order_rng = jax.random.split(rng, 3)
        batch, reward = _ppo_batch(env, config, state, trajectory)
        indices: dict[str, jax.Array] = {
            "ppo": shuffled_minibatches(order_rng, batch["return"].shape[0], self.epochs, self.minibatches)
        }
        state, expert = _expert_samples(env, config, state, trajectory, relabel_rng)
        std = self.policy_std(config, state)  # that of the roll-out, throughout
        if self.bc_batch:
            bc_loss = _bc_loss(env, config, state, expert, std)
            indices["expert"] = expert.draw(draw_rng, (len(indices["ppo"]), self.bc_batch))

        def loss(params: Any, indices: dict[str, jax.Array]) -> tuple[jax.Array, Metrics]:
            part = jax.tree.map(lambda array: array[indices["ppo"]], batch)
            value, metrics = _ppo_loss(env, config, hyper, std, params, part)
            if self.bc_batch:
                cloning = bc_loss(params, indices["expert"])
                value += hyper.bc_weight * cloning
                metrics |= {"bc_loss": cloning}
            return value, metrics

        state, metrics = self.descend(config, state, loss, indices)
        return state.count(policy_samples(env, trajectory)), metrics | {"reward": reward}

    def descend(self, config: Config, state: TrainState, loss: Callable, indices: Any) -> tuple[TrainState, Metrics]:
        """Takes a gradient step of policy and value function for each minibatch, leaves of `indices` `[steps, ...]`."""
        params, optimizer, metrics = descend(
            self.optimizer(config),
            loss,
            state.learner.actor_critic,
            state.learner.optimizer,
            state.hyperparameters.policy_learning_rate,
            indices,
        )
        return state.replace(learner=PPOState(params, optimizer)), metrics


def _ppo_batch(
    env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory
) -> tuple[dict[str, jax.Array], jax.Array]:
    """Returns the samples of a trajectory for PPO, a dict of arrays `[S, ...]`, and their mean reward, `[]`."""
    hyper, weight = state.hyperparameters, step_weight(trajectory)
    observation = state.normalize(trajectory.observation(env))
    value = apply(_value_network(config), state.learner.actor_critic["value"], observation)[..., 0]
    logits = discriminate(config, state.discriminator, observation[:-1], trajectory.action)
    imitation = imitation_reward(hyper.reward, logits)
    reward = (1.0 - hyper.environment_reward) * imitation + hyper.environment_reward * trajectory.reward
    # Episodes have a fixed length, so shifting and scaling the reward ranks no policy above another. Standardised it
    # keeps returns of order one while the discriminator, and with it the reward, drifts: the value function can follow.
    scaled = jnp.where(hyper.standardize_reward, standardize(reward, weight), reward) / env.episode_length
    advantage = generalized_advantages(scaled, value, hyper.discount, hyper.gae_lambda)
    batch = {
        "observation": observation[:-1],
        "action": trajectory.action,
        "log_prob": trajectory.noted,
        "advantage": standardize(advantage, weight),
        "return": advantage + value[:-1],
        "weight": weight,
    }
    return flatten(batch), weighted_mean(reward, weight)


def _ppo_loss(
    env: GoalEnv, config: Config, hyper: Hyperparameters, std: jax.Array, params: Any, part: dict[str, jax.Array]
) -> tuple[jax.Array, Metrics]:
    """Loss of policy and value function on a minibatch, and its parts as metrics."""
    mean = apply(_policy_network(config, env.action_size), params["policy"], part["observation"])
    log_prob = gaussian_log_prob(part["action"], mean, std)
    loss, metrics = policy_loss(log_prob, part["log_prob"], part["advantage"], part["weight"], hyper.clip_ratio)
    predicted = apply(_value_network(config), params["value"], part["observation"])[..., 0]
    value_loss = 0.5 * weighted_mean(jnp.square(predicted - part["return"]), part["weight"])
    return hyper.ppo_weight * loss + value_loss, metrics | {"value_loss": value_loss}


def _bc_loss(
    env: GoalEnv, config: Config, state: TrainState, samples: Samples, std: jax.Array
) -> Callable[[Any, jax.Array], jax.Array]:
    """Returns the BC loss: parameters and indices `[B]` to the mean negative log-likelihood, `[]`."""
    observation = state.normalize(samples.observation)

    def loss(params: Any, indices: jax.Array) -> jax.Array:
        mean = apply(_policy_network(config, env.action_size), params["policy"], observation[indices])
        return -gaussian_log_prob(samples.action[indices], mean, std).mean()

    return loss


def _expert_samples(
    env: GoalEnv,
    config: Config,
    state: TrainState,
    trajectory: Trajectory,
    rng: jax.Array,
    jitter: jax.Array | float = 0.0,
) -> tuple[TrainState, Samples]:
    expert, samples = expert_samples(env, config, state.hyperparameters, state.expert, trajectory, rng, jitter)
    return state.replace(expert=expert), samples


def _policy_network(config: Config, action_size: int) -> MLP:
    """Normalised observation to mean action; starts near zero, so that the first policy explores evenly."""
    return MLP(config.policy_hidden, action_size, 1e-4, config.layer_norm)


def _value_network(config: Config) -> MLP:
    """Normalised observation to the expected return, `[..., 1]`."""
    return MLP(config.policy_hidden, 1, layer_norm=config.layer_norm)

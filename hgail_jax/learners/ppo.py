"""The paper's learner: PPO under the discriminator's reward, each roll-out used once.

Below, `S` is a number of samples, of a roll-out its steps times its episodes, and `B` a minibatch of them.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from hgail_envs import GoalEnv
from hgail_jax.config import PPO, Config, Hyperparameters
from hgail_jax.descent import descend, shuffled_minibatches
from hgail_jax.devices.sharding import local_shard
from hgail_jax.discriminator import discriminate, fit_discriminator, imitation_reward
from hgail_jax.experts import expert_samples
from hgail_jax.learners.base import DISCRIMINATOR, EVALUATE, POLICY, PRETRAIN, SKIP, Learner
from hgail_jax.learners.ppo_loss import generalized_advantages, policy_loss, standardize, weighted_mean
from hgail_jax.networks import MLP, apply, dense_layers, gaussian_log_prob
from hgail_jax.rollout import Policy, Trajectory
from hgail_jax.samples import Samples, flatten, policy_samples, step_weight
from hgail_jax.state import TrainState

Metrics = dict[str, jax.Array]


class PPOState(struct.PyTreeNode):
    """Networks and optimiser of PPO."""

    actor_critic: Any
    """`{"policy": ..., "value": ...}`."""
    optimizer: optax.OptState


class PPOLearner(Learner):
    """PPO (Schulman et al. 2017) with a value function, and behaviour cloning (BC) of the expert samples."""

    metrics = {  # noqa: RUF012  (a ClassVar of the base)
        "reward": "mean reward that the policy was given",
        "policy_loss": "PPO's clipped loss",
        "value_loss": "half the squared error of the value function",
        "clip_fraction": "fraction of samples whose probability ratio is outside the bounds",
        "kl": "estimate of KL(old policy ‖ new policy), nats",
        "bc_loss": "mean negative log-likelihood of expert samples, nats",
        "discriminator_loss": "cross-entropy of the discriminator, 2 log 2 at chance",
        "discriminator_accuracy": "fraction of samples that the discriminator tells right",
    }

    def init(self, env: GoalEnv, config: Config, rngs: jax.Array) -> PPOState:
        """See `Learner`."""
        observation = jnp.zeros(env.observation_size)
        policy_rng, value_rng = rngs
        actor_critic = {
            "policy": _policy_network(config, env.action_size).init(policy_rng, observation),
            "value": _value_network(config).init(value_rng, observation),
        }
        return PPOState(actor_critic, _optimizer(config).init(actor_critic))

    def policy(
        self, env: GoalEnv, config: Config, state: TrainState, noise: jax.Array | float, axis: str | None = None
    ) -> Policy:
        """See `Learner`; the action is Gaussian, without noise its mean."""
        std = action_std(config, state)
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
        if not ppo_sizes(config).policy_phases:  # there are no steps to count
            return jnp.ones(())
        return 1.0 - decay_schedule(config, 0.0)(state.learner.optimizer[-1].count)

    def phase_table(self, config: Config) -> np.ndarray:
        """See `Learner`; row 0 is the pre-training, if there is one."""
        sizes = ppo_sizes(config)
        updates = [POLICY] * sizes.policy_phases + [DISCRIMINATOR] * sizes.discriminator_phases
        first = [PRETRAIN if sizes.pretrain else SKIP] + [SKIP] * len(updates) + [EVALUATE]
        return np.array([first] + [[SKIP, *updates, EVALUATE]] * config.rounds)

    def layers(self, state: TrainState) -> list[tuple[jax.Array, ...]]:
        """See `Learner`."""
        return dense_layers(state.learner.actor_critic["policy"])


def decay_schedule(config: Config, final: jax.Array | float) -> optax.Schedule:
    """Returns a factor by the policy's gradient steps: 1 through the pre-training, then linear to `final`.

    The learning rate falls by it, and so does the policy's standard deviation.
    """
    sizes = ppo_sizes(config)
    pretraining = sizes.pretrain_policy_minibatches if sizes.pretrain else 0
    rounds = config.rounds * sizes.policy_phases * sizes.epochs * sizes.minibatches
    return optax.linear_schedule(1.0, final, rounds, transition_begin=pretraining)


def action_std(config: Config, state: TrainState) -> jax.Array:
    """Returns the policy's standard deviation after the gradient steps so far, `[]` or `[action_size]`."""
    hyper = state.hyperparameters
    return jnp.asarray(hyper.action_std) * decay_schedule(config, hyper.final_action_std)(
        state.learner.optimizer[-1].count
    )


def pretrain(
    env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
) -> tuple[TrainState, Metrics]:
    """Fits policy and discriminator to the expert samples (Algorithm 2, lines 1 to 3).

    The policy by behaviour cloning, the discriminator by cross-entropy of these against the first roll-out as it was.
    """
    relabel_rng, policy_rng, discriminator_rng = jax.random.split(rng, 3)
    state, expert = _expert_samples(env, config, state, trajectory, relabel_rng)
    policy, sizes = policy_samples(env, trajectory), ppo_sizes(config)
    state = _count(state, expert)
    state, cloning = _clone(env, config, state, expert, policy_rng)
    state, metrics = fit_discriminator(
        config, state, expert, policy, sizes.pretrain_discriminator_minibatches, discriminator_rng
    )
    return state, cloning | metrics


def update_discriminator(
    env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
) -> tuple[TrainState, Metrics]:
    """Trains the discriminator on expert samples against a roll-out's own (Algorithm 2, the d_steps)."""
    relabel_rng, fit_rng = jax.random.split(rng)
    state, expert = _expert_samples(env, config, state, trajectory, relabel_rng)
    policy = policy_samples(env, trajectory)
    # The statistics stay: they are the policy's input too, which this phase must not change.
    return fit_discriminator(config, state, expert, policy, config.discriminator_minibatches, fit_rng)


def update_policy(
    env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
) -> tuple[TrainState, Metrics]:
    """Improves the policy by PPO under the discriminator's reward (Algorithm 2, the g_steps).

    With a `bc_batch` each gradient also follows the behaviour-cloning loss of that many expert samples.
    """
    hyper, sizes = state.hyperparameters, ppo_sizes(config)
    relabel_rng, draw_rng, order_rng = jax.random.split(rng, 3)
    batch, reward = _ppo_batch(env, config, state, trajectory)
    indices: dict[str, jax.Array] = {
        "ppo": shuffled_minibatches(order_rng, batch["return"].shape[0], sizes.epochs, sizes.minibatches)
    }
    state, expert = _expert_samples(env, config, state, trajectory, relabel_rng)
    if sizes.bc_batch:
        bc_loss = _bc_loss(env, config, state, expert)
        indices["expert"] = expert.draw(draw_rng, (len(indices["ppo"]), sizes.bc_batch))

    std = action_std(config, state)  # that of the roll-out, throughout

    def loss(params: Any, indices: dict[str, jax.Array]) -> tuple[jax.Array, Metrics]:
        part = jax.tree.map(lambda array: array[indices["ppo"]], batch)
        value, metrics = _ppo_loss(env, config, hyper, std, params, part)
        if sizes.bc_batch:
            cloning = bc_loss(params, indices["expert"])
            value += hyper.bc_weight * cloning
            metrics |= {"bc_loss": cloning}
        return value, metrics

    state, metrics = _improve(config, state, loss, indices)
    return _count(state, policy_samples(env, trajectory)), metrics | {"reward": reward}


PPOLearner.updates = {PRETRAIN: pretrain, POLICY: update_policy, DISCRIMINATOR: update_discriminator}


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
    scaled *= hyper.reward_scale
    advantage = generalized_advantages(scaled, value, hyper.discount, hyper.gae_lambda)
    batch = {
        "observation": observation[:-1],
        "action": trajectory.action,
        "log_prob": trajectory.log_prob,
        "advantage": jnp.where(hyper.standardize_advantage, standardize(advantage, weight), advantage),
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
    policy = policy_loss(log_prob, part["log_prob"], part["advantage"], part["weight"], hyper.clip_ratio)
    predicted = apply(_value_network(config), params["value"], part["observation"])[..., 0]
    value_loss = 0.5 * weighted_mean(jnp.square(predicted - part["return"]), part["weight"])
    return hyper.ppo_weight * policy.loss + value_loss, {
        "policy_loss": policy.loss,
        "value_loss": value_loss,
        "clip_fraction": policy.clip_fraction,
        "kl": policy.kl,
    }


def _bc_loss(
    env: GoalEnv, config: Config, state: TrainState, samples: Samples
) -> Callable[[Any, jax.Array], jax.Array]:
    """Returns the behaviour-cloning loss: parameters and indices `[B]` to the mean negative log-likelihood, `[]`."""
    observation, std = state.normalize(samples.observation), action_std(config, state)

    def loss(params: Any, indices: jax.Array) -> jax.Array:
        mean = apply(_policy_network(config, env.action_size), params["policy"], observation[indices])
        return -gaussian_log_prob(samples.action[indices], mean, std).mean()

    return loss


def _clone(
    env: GoalEnv, config: Config, state: TrainState, samples: Samples, rng: jax.Array
) -> tuple[TrainState, Metrics]:
    bc_loss, sizes = _bc_loss(env, config, state, samples), ppo_sizes(config)

    def loss(params: Any, indices: jax.Array) -> tuple[jax.Array, Metrics]:
        value = bc_loss(params, indices)
        return value, {"bc_loss": value}

    shape = (sizes.pretrain_policy_minibatches, sizes.pretrain_policy_batch)
    return _improve(config, state, loss, samples.draw(rng, shape))


def _improve(config: Config, state: TrainState, loss: Callable, indices: Any) -> tuple[TrainState, Metrics]:
    params, optimizer, metrics = descend(
        _optimizer(config),
        loss,
        state.learner.actor_critic,
        state.learner.optimizer,
        state.hyperparameters.policy_learning_rate,
        indices,
    )
    return state.replace(learner=PPOState(params, optimizer)), metrics


def _expert_samples(
    env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
) -> tuple[TrainState, Samples]:
    """Returns (state with the new expert buffer, expert samples)."""
    expert, samples = expert_samples(env, config, state.hyperparameters, state.expert, trajectory, rng)
    return state.replace(expert=expert), samples


def _count(state: TrainState, samples: Samples) -> TrainState:
    """Counts samples into the state's statistics, each of them once whatever its weight.

    Expert samples in the pre-training, the policy's own in its updates. A policy forgets as far as the statistics move,
    and after the pre-training they move less if they begin with the samples that it imitates, not with its behaviour
    before.
    """
    return state.count(samples.observation, (samples.weight > 0).astype(jnp.float32))


def ppo_sizes(config: Config) -> PPO:
    """Returns the sizes of PPO; a TypeError if the config is of another learner."""
    if not isinstance(config.learner, PPO):
        raise TypeError(f"{config.learner} is not PPO")
    return config.learner


def _optimizer(config: Config) -> optax.GradientTransformation:
    """Adam for policy and value function, without the learning rate, which is a hyperparameter of the state."""
    decay = decay_schedule(config, ppo_sizes(config).final_learning_rate)
    return optax.chain(optax.scale_by_adam(), optax.scale_by_schedule(decay))


def _policy_network(config: Config, action_size: int) -> MLP:
    """Normalised observation to mean action; starts near zero, so that the first policy explores evenly."""
    return MLP(config.policy_hidden, action_size, 1e-4, config.layer_norm)


def _value_network(config: Config) -> MLP:
    """Normalised observation to the expected return, `[..., 1]`."""
    return MLP(config.policy_hidden, 1, layer_norm=config.layer_norm)

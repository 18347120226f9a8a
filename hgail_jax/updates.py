"""What a roll-out teaches: the updates of policy, value function and discriminator.

Below, `S` is a number of samples, of a roll-out its steps times its episodes, and `B` a minibatch of them.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs import GoalEnv
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.discriminator import discriminator_accuracy, discriminator_loss
from hgail_jax.distributed.sharding import local_shard
from hgail_jax.experts import expert_samples
from hgail_jax.networks import apply, discriminator_network, gaussian_log_prob, policy_network, value_network
from hgail_jax.ppo import generalized_advantages, policy_loss, standardize, weighted_mean
from hgail_jax.rewards import imitation_reward
from hgail_jax.rollout import Policy, Trajectory
from hgail_jax.samples import Samples, flatten, policy_samples, step_weight
from hgail_jax.state import Params, TrainState, actor_critic_optimizer, discriminator_optimizer


class UpdateMetrics(struct.PyTreeNode):
    """What an update did, all `[]`; what a kind of update does not measure stays 0."""

    reward: jax.Array | float = 0.0
    """Mean reward that the policy was given."""
    policy_loss: jax.Array | float = 0.0
    value_loss: jax.Array | float = 0.0
    clip_fraction: jax.Array | float = 0.0
    kl: jax.Array | float = 0.0
    likelihood_loss: jax.Array | float = 0.0
    """Mean negative log-likelihood of expert samples, nats."""
    discriminator_loss: jax.Array | float = 0.0
    discriminator_accuracy: jax.Array | float = 0.0


def make_policy(
    env: GoalEnv, config: Config, state: TrainState, noise: jax.Array | float, axis: str | None = None
) -> Policy:
    """Returns the policy of `state`, to be rolled out.

    Args:
      env: the task.
      config: sizes and counts.
      state: the learner.
      noise: 1 to explore, 0 for the mean action; may be traced.
      axis: see `rollout`; in a device's part of the environments the policy acts as it would in all of them.

    """
    std = state.action_std(config)
    network = policy_network(config, env.action_size)

    def policy(observation: jax.Array, rng: jax.Array) -> tuple[jax.Array, jax.Array]:
        mean = apply(network, state.actor_critic["policy"], state.normalize(observation))
        of_all = mean.shape if axis is None else (len(mean) * jax.lax.axis_size(axis), env.action_size)
        action = mean + noise * std * local_shard(jax.random.normal(rng, of_all), axis)
        return action, gaussian_log_prob(action, mean, std)

    return policy


def pretrain(
    env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
) -> tuple[TrainState, UpdateMetrics]:
    """Fits policy and discriminator to the expert samples (Algorithm 2, lines 1 to 3).

    The policy by maximum likelihood, the discriminator by cross-entropy of these against the first roll-out as it was.
    Returns the new state and its `UpdateMetrics`.
    """
    relabel_rng, policy_rng, discriminator_rng = jax.random.split(rng, 3)
    state, expert = _expert_samples(env, config, state, trajectory, relabel_rng)
    policy = policy_samples(env, trajectory)
    state = _observe(state, expert)
    state, policy_metrics = _maximize_likelihood(env, config, state, expert, policy_rng)
    state, metrics = _fit_discriminator(
        config, state, expert, policy, config.pretrain_discriminator_minibatches, discriminator_rng
    )
    return state, metrics.replace(likelihood_loss=policy_metrics.likelihood_loss)


def update_discriminator(
    env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
) -> tuple[TrainState, UpdateMetrics]:
    """Teaches the discriminator the expert samples against a roll-out's own (Algorithm 2, the d_steps)."""
    relabel_rng, fit_rng = jax.random.split(rng)
    state, expert = _expert_samples(env, config, state, trajectory, relabel_rng)
    policy = policy_samples(env, trajectory)
    # The statistics stay: they are the policy's input too, which this phase must not change.
    return _fit_discriminator(config, state, expert, policy, config.discriminator_minibatches, fit_rng)


def update_policy(
    env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
) -> tuple[TrainState, UpdateMetrics]:
    """Improves the policy by PPO under the discriminator's reward (Algorithm 2, the g_steps).

    With a `likelihood_batch` each gradient also follows the likelihood of that many expert samples.
    """
    hyper = state.hyperparameters
    relabel_rng, draw_rng, order_rng = jax.random.split(rng, 3)
    batch, metrics = _ppo_batch(env, config, state, trajectory)
    indices: dict[str, jax.Array] = {
        "ppo": _minibatches(order_rng, batch["return"].shape[0], config.ppo_epochs, config.ppo_minibatches)
    }
    state, expert = _expert_samples(env, config, state, trajectory, relabel_rng)
    if config.likelihood_batch:
        negative_log_likelihood = _negative_log_likelihood(env, config, state, expert)
        indices["expert"] = expert.draw(draw_rng, (len(indices["ppo"]), config.likelihood_batch))

    std = state.action_std(config)  # that of the roll-out, throughout

    def loss(params: Params, indices: dict[str, jax.Array]) -> tuple[jax.Array, UpdateMetrics]:
        value, metrics = _ppo_loss(
            env, config, hyper, std, params, jax.tree.map(lambda array: array[indices["ppo"]], batch)
        )
        if config.likelihood_batch:
            likelihood = negative_log_likelihood(params, indices["expert"])
            value += hyper.likelihood_weight * likelihood
            metrics = metrics.replace(likelihood_loss=likelihood)
        return value, metrics

    state, updates = _improve_actor_critic(config, state, loss, indices)
    return _observe(state, policy_samples(env, trajectory)), updates.replace(reward=metrics.reward)


def _ppo_batch(
    env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory
) -> tuple[dict[str, jax.Array], UpdateMetrics]:
    """Returns what PPO learns from a trajectory, a dict of arrays `[S, ...]`, and the mean reward as metrics."""
    hyper, weight = state.hyperparameters, step_weight(trajectory)
    observation = state.normalize(trajectory.observation(env))
    value = apply(value_network(config), state.actor_critic["value"], observation)[..., 0]
    logits = _discriminate(config, state.discriminator, observation[:-1], trajectory.action)
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
    return flatten(batch), UpdateMetrics(reward=weighted_mean(reward, weight))


def _ppo_loss(
    env: GoalEnv, config: Config, hyper: Hyperparameters, std: jax.Array, params: Params, part: dict[str, jax.Array]
) -> tuple[jax.Array, UpdateMetrics]:
    """Returns the loss of policy and value function on a minibatch, and what to watch about it."""
    mean = apply(policy_network(config, env.action_size), params["policy"], part["observation"])
    log_prob = gaussian_log_prob(part["action"], mean, std)
    policy = policy_loss(log_prob, part["log_prob"], part["advantage"], part["weight"], hyper.clip_ratio)
    predicted = apply(value_network(config), params["value"], part["observation"])[..., 0]
    value_loss = 0.5 * weighted_mean(jnp.square(predicted - part["return"]), part["weight"])
    return hyper.ppo_weight * policy.loss + value_loss, UpdateMetrics(
        policy_loss=policy.loss, value_loss=value_loss, clip_fraction=policy.clip_fraction, kl=policy.kl
    )


def _negative_log_likelihood(
    env: GoalEnv, config: Config, state: TrainState, samples: Samples
) -> Callable[[Params, jax.Array], jax.Array]:
    """Returns a function of parameters and indices `[B]` of `samples` to their mean negative log-likelihood, `[]`."""
    observation, std = state.normalize(samples.observation), state.action_std(config)

    def loss(params: Params, indices: jax.Array) -> jax.Array:
        mean = apply(policy_network(config, env.action_size), params["policy"], observation[indices])
        return -gaussian_log_prob(samples.action[indices], mean, std).mean()

    return loss


def _maximize_likelihood(
    env: GoalEnv, config: Config, state: TrainState, samples: Samples, rng: jax.Array
) -> tuple[TrainState, UpdateMetrics]:
    negative_log_likelihood = _negative_log_likelihood(env, config, state, samples)

    def loss(params: Params, indices: jax.Array) -> tuple[jax.Array, UpdateMetrics]:
        value = negative_log_likelihood(params, indices)
        return value, UpdateMetrics(likelihood_loss=value)

    shape = (config.pretrain_policy_minibatches, config.pretrain_policy_batch)
    return _improve_actor_critic(config, state, loss, samples.draw(rng, shape))


def _fit_discriminator(
    config: Config, state: TrainState, expert: Samples, policy: Samples, minibatches: int, rng: jax.Array
) -> tuple[TrainState, UpdateMetrics]:
    expert_observation, policy_observation = state.normalize(expert.observation), state.normalize(policy.observation)

    def loss(params: Params, indices: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, UpdateMetrics]:
        of_expert, of_policy = indices
        expert_logits = _discriminate(config, params, expert_observation[of_expert], expert.action[of_expert])
        policy_logits = _discriminate(config, params, policy_observation[of_policy], policy.action[of_policy])
        value = discriminator_loss(expert_logits, policy_logits)
        return value, UpdateMetrics(
            discriminator_loss=value, discriminator_accuracy=discriminator_accuracy(expert_logits, policy_logits)
        )

    expert_rng, policy_rng = jax.random.split(rng)
    shape = (minibatches, config.discriminator_batch)
    indices = expert.draw(expert_rng, shape), policy.draw(policy_rng, shape)
    params, optimizer, metrics = _descend(
        discriminator_optimizer(),
        loss,
        state.discriminator,
        state.discriminator_optimizer,
        state.hyperparameters.discriminator_learning_rate,
        indices,
    )
    return state.replace(discriminator=params, discriminator_optimizer=optimizer), metrics


def _discriminate(config: Config, params: Params, observation: jax.Array, action: jax.Array) -> jax.Array:
    """Logits, `[...]`, of normalised observations and of actions as the environment takes them: clipped."""
    inputs = jnp.concatenate([observation, jnp.clip(action, -1.0, 1.0)], axis=-1)
    return apply(discriminator_network(config), params, inputs)[..., 0]


def _improve_actor_critic(
    config: Config, state: TrainState, loss: Callable, indices: Any
) -> tuple[TrainState, UpdateMetrics]:
    params, optimizer, metrics = _descend(
        actor_critic_optimizer(config),
        loss,
        state.actor_critic,
        state.actor_critic_optimizer,
        state.hyperparameters.policy_learning_rate,
        indices,
    )
    return state.replace(actor_critic=params, actor_critic_optimizer=optimizer), metrics


def _descend(
    optimizer: optax.GradientTransformation,
    loss: Callable,
    params: Params,
    optimizer_state: optax.OptState,
    learning_rate: jax.Array | float,
    minibatches: Any,
) -> tuple[Params, optax.OptState, Any]:
    """Takes a step for each entry of `minibatches` along its first axis; returns the mean metrics too."""

    def step(carry: tuple[Params, optax.OptState], minibatch: Any) -> tuple[tuple[Params, optax.OptState], Any]:
        params, optimizer_state = carry
        gradient, metrics = jax.grad(loss, has_aux=True)(params, minibatch)
        update, optimizer_state = optimizer.update(gradient, optimizer_state)
        params = optax.apply_updates(params, jax.tree.map(lambda leaf: -learning_rate * leaf, update))
        return (params, optimizer_state), metrics

    (params, optimizer_state), metrics = jax.lax.scan(step, (params, optimizer_state), minibatches)
    return params, optimizer_state, jax.tree.map(jnp.mean, metrics)


def _minibatches(rng: jax.Array, samples: int, epochs: int, minibatches: int) -> jax.Array:
    """Indices `[epochs * minibatches, B]`: every pass goes through the samples in a new order, less a remainder."""
    size = samples // minibatches
    orders = jax.vmap(lambda rng: jax.random.permutation(rng, samples))(jax.random.split(rng, epochs))
    return orders[:, : size * minibatches].reshape(epochs * minibatches, size)


def _expert_samples(
    env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
) -> tuple[TrainState, Samples]:
    """Returns the state with what is kept of the trajectory, and the expert samples to learn from."""
    expert, samples = expert_samples(env, config, state.hyperparameters, state.expert, trajectory, rng)
    return state.replace(expert=expert), samples


def _observe(state: TrainState, samples: Samples) -> TrainState:
    """Counts samples into the state's statistics; how often they are to be drawn does not matter here.

    Expert samples in the pre-training, the policy's own in its updates, each of them once. A policy forgets as far as
    the statistics move, and after the pre-training they move less if they begin with what it is to imitate, not with
    how it behaved before.
    """
    return state.observe(samples.observation, (samples.weight > 0).astype(jnp.float32))

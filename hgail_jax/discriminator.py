"""The discriminator separates relabelled samples from the policy's own: its network, input, loss, training and rewards.

Sign. A high logit, called `dis` in the paper, means "as an expert's". The paper's D is the opposite, 1 on samples of
the policy: D = 1 - σ(dis). Cross-entropy therefore labels expert (here relabelled) samples 1 and the policy's
own samples 0; at its optimum dis = log p_expert(s, a) - log p_policy(s, a), and a reward that grows with dis draws the
policy towards the expert's samples.
"""

from typing import Any

import jax
import jax.numpy as jnp
import optax

from hgail_envs import GoalEnv
from hgail_jax.config import Config
from hgail_jax.descent import descend
from hgail_jax.networks import MLP, apply
from hgail_jax.samples import Samples
from hgail_jax.state import TrainState

_R2_FLOOR = 1e-3  # r2 takes the logarithm of a number that may be 0
_LEAST_SQUARE = 1e-12  # under a square root, whose gradient is infinite at 0


def init_discriminator(env: GoalEnv, config: Config, rng: jax.Array) -> tuple[Any, optax.OptState]:
    """Returns the parameters of an untrained discriminator and its optimiser's state."""
    params = _network(config).init(rng, jnp.zeros(env.goal_observation_size + env.action_size))
    return params, _optimizer().init(params)


def discriminate(config: Config, params: Any, observation: jax.Array, action: jax.Array) -> jax.Array:
    """Returns logits, `[...]`, of normalised observations and of actions as the environment takes them: clipped."""
    inputs = jnp.concatenate([observation, jnp.clip(action, -1.0, 1.0)], axis=-1)
    return apply(_network(config), params, inputs)[..., 0]


def discriminator_loss(
    expert_logits: jax.Array, policy_logits: jax.Array, policy_weight: jax.Array | float = 1.0
) -> jax.Array:
    """Binary cross-entropy, `[]`: expert samples `[B]` towards 1 plus policy samples `[B]` towards 0.

    At chance it is 2 log 2, about 1.39. A `policy_weight` of w lowers the best logit by log w.
    """
    expert = optax.sigmoid_binary_cross_entropy(expert_logits, jnp.ones_like(expert_logits))
    policy = optax.sigmoid_binary_cross_entropy(policy_logits, jnp.zeros_like(policy_logits))
    return expert.mean() + policy_weight * policy.mean()


def discriminator_accuracy(expert_logits: jax.Array, policy_logits: jax.Array) -> jax.Array:
    """Fraction of samples on the right side of 0, `[]`; one half is chance."""
    return 0.5 * (jnp.mean(expert_logits > 0) + jnp.mean(policy_logits <= 0))


def fit_discriminator(
    config: Config,
    state: TrainState,
    expert: Samples,
    policy: Samples,
    minibatches: int,
    rng: jax.Array,
    decay: jax.Array | float = 1.0,
    penalty: float = 0.0,
) -> tuple[TrainState, dict[str, jax.Array]]:
    """Trains the discriminator for some minibatches; returns the new state and the mean loss and accuracy.

    Its learning rate is multiplied by `decay`, and `penalty` is the weight of the `gradient_penalty`.
    """
    expert_observation, policy_observation = state.normalize(expert.observation), state.normalize(policy.observation)
    hyper = state.hyperparameters

    def loss(params: Any, indices: tuple[jax.Array, ...]) -> tuple[jax.Array, dict[str, jax.Array]]:
        of_expert, of_policy, *share = indices
        shown = expert_observation[of_expert], expert.action[of_expert]
        own = policy_observation[of_policy], policy.action[of_policy]
        expert_logits, policy_logits = discriminate(config, params, *shown), discriminate(config, params, *own)
        value = discriminator_loss(expert_logits, policy_logits, hyper.negative_weight)
        metrics = {"discriminator_loss": value}
        metrics["discriminator_accuracy"] = discriminator_accuracy(expert_logits, policy_logits)
        if penalty:
            value += penalty * gradient_penalty(config, params, shown, own, *share)
        return value, metrics

    expert_rng, policy_rng = jax.random.split(rng)
    shape = (minibatches, config.discriminator_batch)
    indices: tuple[jax.Array, ...] = expert.draw(expert_rng, shape), policy.draw(policy_rng, shape)
    if penalty:
        indices += (jax.random.uniform(jax.random.fold_in(rng, 2), (*shape, 1)),)
    params, optimizer, metrics = descend(
        _optimizer(),
        loss,
        state.discriminator,
        state.discriminator_optimizer,
        hyper.discriminator_learning_rate * decay,
        indices,
    )
    return state.replace(discriminator=params, discriminator_optimizer=optimizer), metrics


def gradient_penalty(
    config: Config,
    params: Any,
    expert: tuple[jax.Array, jax.Array],
    policy: tuple[jax.Array, jax.Array],
    share: jax.Array,
) -> jax.Array:
    """Mean of (|gradient of the logit by its input| - 1)², `[]`, between samples (Gulrajani et al. 2017).

    Normalised observations and actions, `[B, ...]`, of the expert and of the policy are mixed, each sample with a
    `share`, `[B, 1]` in [0, 1], of the expert's.
    """
    mixed = jax.tree.map(lambda of_expert, of_policy: share * of_expert + (1.0 - share) * of_policy, expert, policy)
    gradients = jax.vmap(jax.grad(lambda pair: discriminate(config, params, *pair)))(mixed)
    square = sum(jnp.square(gradient).sum(axis=-1) for gradient in gradients)
    return jnp.mean(jnp.square(jnp.sqrt(square + _LEAST_SQUARE) - 1.0))


def _network(config: Config) -> MLP:
    """Normalised observation and clipped action, concatenated, to the logit, `[..., 1]`."""
    return MLP(config.discriminator_hidden, 1, layer_norm=config.layer_norm)


def _optimizer() -> optax.GradientTransformation:
    """Adam, without the learning rate, which is a hyperparameter of the state."""
    return optax.scale_by_adam()


def imitation_reward(form: jax.Array | int, logits: jax.Array) -> jax.Array:
    """Returns the reward of logits, `[...]`, in a form of `REWARDS`, which may be traced.

    These are the four forms that the paper's figure 7 compares. The logit is the paper's `dis`, high where a sample
    looks like an expert's, and all four grow with it.
    """
    return jax.lax.switch(form, (r1, r2, r3, r4), logits)


def bounded_reward(
    config: Config, state: TrainState, observation: jax.Array, action: jax.Array, reached: jax.Array
) -> jax.Array:
    """Returns rewards in [-1, 0], `[...]`, of samples whose next states are at their goals, or not, by `reached`.

    The discriminator's is σ(logit) - 1, the probability of an expert's sample less 1, so that it can be mixed with the
    goal test and critics have one bound. Where none is trained the goal test is the whole reward.
    """
    goal_test = reached.astype(jnp.float32) - 1.0
    if not config.discriminator_minibatches:
        return goal_test
    logits = discriminate(config, state.discriminator, state.normalize(observation), action)
    weight = state.hyperparameters.environment_reward
    return (1.0 - weight) * (jax.nn.sigmoid(logits) - 1.0) + weight * goal_test


def r1(logits: jax.Array) -> jax.Array:
    """-log(1 - σ(logit)), which is softplus(logit): never negative, the paper's default."""
    return jax.nn.softplus(logits)


def r2(logits: jax.Array) -> jax.Array:
    """Log clip(logit, 0, 1), with a floor of 1e-3 under the logarithm: flat where the logit is outside (0, 1)."""
    return jnp.log(jnp.clip(logits, _R2_FLOOR, 1.0))


def r3(logits: jax.Array) -> jax.Array:
    """The logit itself: log p_expert - log p_policy for the best discriminator."""
    return logits


def r4(logits: jax.Array) -> jax.Array:
    """Log σ(logit) - log(1 - σ(logit)): by algebra the logit again, so that r4 and r3 differ by rounding alone."""
    return jax.nn.log_sigmoid(logits) - jax.nn.log_sigmoid(-logits)

"""Contrastive RL: the critic tells which goals an episode achieves later (Eysenbach et al. 2022, arXiv 2206.07568).

There is neither a reward nor bootstrapping. The critic f(s, a, g) = φ(s, a)ᵀψ(g) is trained by InfoNCE: at its best it
is log p(g achieved later | s, a) - log p(g) up to a constant. The actor maximises it. Roll-outs, buffer and exploration
are TD3's. Below, `B` is the samples in a gradient step.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax

from hgail_envs import GoalEnv
from hgail_jax.buffer import draw, draw_future
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.learners.td3 import TD3, TD3Hyperparameters, fill_buffer
from hgail_jax.learners.td3_step import PREACTIVATION_WEIGHT, Batch, GradientStep, Metrics, Networks
from hgail_jax.networks import MLP, apply
from hgail_jax.rollout import Trajectory
from hgail_jax.state import TrainState


class Encoders(NamedTuple):
    """Parameters of a critic; those of an ensemble have a leading axis."""

    pair: Any
    """φ: normalised features and action, `[B, feature_size + action_size]`, to `[B, representation]`."""
    goal: Any
    """ψ: normalised goal, `[B, goal_size]`, to the same."""


@dataclasses.dataclass(frozen=True)
class CRL(TD3):
    """Contrastive RL with TD3's roll-outs, on a task whose observation is features and goal.

    A value out of its range is a ValueError.
    """

    name: ClassVar[str] = "crl"
    metrics: ClassVar[Mapping[str, str]] = {
        "value": "mean logit of the goals that samples' own episodes achieve later",
        "value_loss": "InfoNCE loss of the critics, 2 log B each at chance",
        "policy_loss": "loss of the actor",
    }
    without_effect: ClassVar[tuple[str, ...]] = (*TD3.without_effect, "strategy", "environment_reward", "bc_weight")
    ignored: ClassVar[tuple[str, ...]] = (
        *("target_noise", "include_current", "solved_weight", "gradient_penalty", "discriminator_minibatches"),
        *("discriminator_batch", "discriminator_hidden", "discriminator_learning_rate", "discriminator_horizon"),
        *("final_discriminator_learning_rate", "negative_p_ht", "negative_weight", "goal_jitter", "shuffled_goals"),
    )

    representation: int = 64
    """Size of φ(s, a) and ψ(g)."""

    def validate(self, env: GoalEnv, config: Config) -> None:
        """See `Learner`; φ must see nothing of the goal."""
        super().validate(env, config)
        with jax.ensure_compile_time_eval():
            goals = jnp.eye(env.goal_size)
            features = jnp.tile(jnp.arange(float(env.feature_size)), (env.goal_size, 1))
            usual = GoalEnv.goal_observation(env, features, goals)
            if not jnp.array_equal(env.goal_observation(features, goals), usual):
                raise ValueError(f"the learner {self.name} needs a task whose observation is its features and its goal")

    def check_hyperparameters(self, config: Config, hyper: Hyperparameters) -> None:
        """See `Learner`; the discount must end the horizon."""
        if np.any(np.asarray(hyper.discount) == 1.0):
            raise ValueError(f"discount is {hyper.discount}; the learner {self.name} needs one below 1")

    def init_critic(self, env: GoalEnv, config: Config, rng: jax.Array) -> Encoders:
        """See `TD3`."""
        inputs = jnp.zeros(env.feature_size + env.action_size), jnp.zeros(env.goal_size)
        return Encoders(*map(_encoder(config).init, jax.random.split(rng), inputs))

    def update(
        self, env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """Adds a roll-out to the buffer, then trains critics and actor on samples of all of it.

        The actor's goals are the critics' with probability `p_ht`, else those pursued.
        """
        draw_rng, future_rng, chosen_rng = jax.random.split(rng, 3)
        hyper = cast(TD3Hyperparameters, state.hyperparameters)
        state = fill_buffer(env, state, trajectory)
        drawn = draw(env, hyper, state.buffer, draw_rng, self.updates * self.batch, 0.0)
        future = draw_future(state.buffer, drawn, hyper.discount, future_rng)
        sought = jnp.where(jax.random.bernoulli(chosen_rng, hyper.p_ht, (len(future), 1)), future, drawn.goal)
        batch = Batch(
            observation=state.normalize(env.goal_observation(drawn.features, future)),
            action=drawn.action,
            weight=drawn.weight,
            actor_input=state.normalize(env.goal_observation(drawn.features, sought)),
        )
        minibatches = jax.tree.map(lambda leaf: leaf.reshape(self.updates, self.batch, *leaf.shape[1:]), batch)
        learner, measured = jax.lax.scan(ContrastiveStep(config, hyper, env.goal_size), state.learner, minibatches)
        return state.replace(learner=learner), {name: values.mean() for name, values in measured.items()}


@dataclasses.dataclass(frozen=True, eq=False)
class ContrastiveStep(GradientStep):
    """A gradient step of contrastive critics and the actor."""

    goal_size: int

    def encode(self, critics: Encoders, observation: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns φ(s, a) and ψ(g) of all critics, `[critics, B, representation]`."""
        features, goal = observation[:, : -self.goal_size], observation[:, -self.goal_size :]
        pair, encoder = jnp.concatenate([features, action], axis=-1), _encoder(self.config)
        return jax.vmap(lambda each: (apply(encoder, each.pair, pair), apply(encoder, each.goal, goal)))(critics)

    def values(self, critics: Encoders, observation: jax.Array, action: jax.Array) -> jax.Array:
        """Returns the logits of samples under their own goals, `[critics, B]`."""
        pair, goal = self.encode(critics, observation, action)
        return jnp.sum(pair * goal, axis=-1)

    def critic_loss(self, critics: Encoders, target: Networks, batch: Batch) -> tuple[jax.Array, jax.Array]:
        """Returns the sum of the critics' losses, `[]`, and their logits of own goals, `[critics, B]`."""
        logits = jnp.einsum("cik,cjk->cij", *self.encode(critics, batch.observation, batch.action))
        loss = jax.vmap(contrastive_loss, in_axes=(0, None))(logits, batch.weight)
        return loss.sum(), jnp.diagonal(logits, axis1=1, axis2=2)

    def actor_loss(self, params: Any, critics: Any, batch: Batch, value: jax.Array) -> tuple[jax.Array, Metrics]:
        """Returns the actor's loss, `[]`, and no metrics: minus the logit of the actor's goals, which is in nats."""
        preactivation, _, metrics = self.act(params, batch)
        gained = self.values(critics, batch.actor_input, jnp.tanh(preactivation)).mean(axis=0)
        return PREACTIVATION_WEIGHT * jnp.square(preactivation).mean() - jnp.mean(batch.weight * gained), metrics


def contrastive_loss(logits: jax.Array, weight: jax.Array) -> jax.Array:
    """Returns the symmetric InfoNCE loss, `[]`, of pairs of state and action against goals.

    Both directions together leave no term of the pair or of the goal alone undecided, as each would.

    Args:
      logits: `[B, B]`, pairs by goals, a pair's own on the diagonal.
      weight: `[B]`; a sample of weight 0 is no negative either.
    """
    own, sound = jnp.arange(len(weight)), weight[None] > 0.0
    loss = functools.partial(optax.softmax_cross_entropy_with_integer_labels, labels=own, where=sound)
    return jnp.mean(weight * (loss(logits) + loss(logits.T)))


def _encoder(config: Config) -> MLP:
    return MLP(config.policy_hidden, cast(CRL, config.learner).representation, layer_norm=config.layer_norm)

"""The training step: one round of Algorithm 2 as a pure function.

A round is a row of phases, each of which is one roll-out and what is done with it. A scan over the phases runs them,
so the roll-out is traced and compiled once whatever the round holds, and `schedule` lists the rounds of a whole run:

    state, metrics = jax.lax.scan(functools.partial(train_step, env, config), state, schedule(config))
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs import EpisodeMetrics, GoalEnv
from hgail_jax.config import Config
from hgail_jax.evaluate import mean_outcome
from hgail_jax.rollout import rollout
from hgail_jax.state import TrainState
from hgail_jax.updates import UpdateMetrics, act, pretrain, update_discriminator, update_policy

SKIP, PRETRAIN, POLICY, DISCRIMINATOR, EVALUATE = range(5)
"""Kinds of phase: nothing; fit to the first roll-out; PPO; discriminator; measure the mean action."""


class RoundMetrics(struct.PyTreeNode):
    """Means over the phases of a round, all `[]`; NaN where the round has no such phase."""

    evaluation: EpisodeMetrics
    """Episodes under the mean action."""
    training: EpisodeMetrics
    """Episodes under the stochastic policy."""
    update: UpdateMetrics
    dropped: jax.Array
    """Share of all episodes whose simulation broke down; nothing was learnt from them."""
    overflow: jax.Array
    """Share of all episodes whose simulation ran out of room for contacts: with more than 0 results are wrong."""


def schedule(config: Config) -> np.ndarray:
    """Returns the phases of a whole run, integers `[rounds + 1, phases]`.

    Row 0 is the pre-training, if there is one; every row ends with an evaluation.
    """
    updates = [POLICY] * config.policy_phases + [DISCRIMINATOR] * config.discriminator_phases
    first = [PRETRAIN if config.pretrain else SKIP] + [SKIP] * len(updates) + [EVALUATE]
    return np.array([first] + [[SKIP, *updates, EVALUATE]] * config.rounds)


def env_steps(env: GoalEnv, config: Config, phases: np.ndarray) -> np.ndarray:
    """Returns the environment steps that each row of a schedule learns from; evaluations do not count."""
    learning = np.isin(phases, [PRETRAIN, POLICY, DISCRIMINATOR])
    return learning.sum(axis=-1) * config.num_envs * env.episode_length


def train_step(
    env: GoalEnv, config: Config, state: TrainState, phases: jax.Array | np.ndarray, axis: str | None = None
) -> tuple[TrainState, RoundMetrics]:
    """Runs one round. Pure: bind `env` and `config`, then jit, scan over a schedule, or vmap over states.

    Args:
      env: the task.
      config: sizes and counts.
      state: the learner, from `init_state` or an earlier step.
      phases: `[phases]`, a row of a schedule. Under a vmap over states leave it unbatched, so that a phase runs its
        own update and no other.
      axis: within a `jax.shard_map`, the mesh axis that the environments are split along; see `rollout`.

    Returns:
      The learner after the round, and what the round measured.

    """
    phases = jnp.asarray(phases)
    state, (episodes, updates, dropped, overflow) = jax.lax.scan(
        functools.partial(_run_phase, env, config, axis), state, phases
    )
    return state, RoundMetrics(
        evaluation=jax.tree.map(lambda values: _masked_mean(values, phases == EVALUATE), episodes),
        training=jax.tree.map(lambda values: _masked_mean(values, (phases != SKIP) & (phases < EVALUATE)), episodes),
        update=UpdateMetrics(**{name: _mean_over(phases, name, values) for name, values in vars(updates).items()}),
        dropped=_masked_mean(dropped, phases != SKIP),
        overflow=_masked_mean(overflow, phases != SKIP),
    )


MEASURED_BY = {
    "reward": (POLICY,),
    "policy_loss": (POLICY,),
    "likelihood_loss": (PRETRAIN, POLICY),
    "value_loss": (POLICY,),
    "clip_fraction": (POLICY,),
    "kl": (POLICY,),
    "discriminator_loss": (PRETRAIN, DISCRIMINATOR),
    "discriminator_accuracy": (PRETRAIN, DISCRIMINATOR),
}
"""Kinds of phase that fill each of `UpdateMetrics`."""


def _mean_over(phases: jax.Array, name: str, values: jax.Array) -> jax.Array:
    return _masked_mean(values, jnp.isin(phases, jnp.array(MEASURED_BY[name])))


def evaluation_rng(state: TrainState) -> jax.Array:
    """Returns the key of an evaluation of `state`, apart from those of its training, in which it changes nothing."""
    return jax.random.fold_in(state.rng, 1)


def _run_phase(env: GoalEnv, config: Config, axis: str | None, state: TrainState, phase: jax.Array):
    def skip(state):
        return state, (_as_arrays(EpisodeMetrics()), _as_arrays(UpdateMetrics()), jnp.zeros(()), jnp.zeros(()))

    def run(state):
        evaluating = phase == EVALUATE
        rng, own_rng = jax.lax.cond(
            evaluating, lambda: (state.rng, evaluation_rng(state)), lambda: tuple(jax.random.split(state.rng))
        )
        rollout_rng, update_rng = jax.random.split(own_rng)
        task = env.exploring(~evaluating if config.explore else False)
        policy = act(env, config, state, noise=jnp.where(evaluating, 0.0, 1.0), axis=axis)
        trajectory = rollout(task, policy, rollout_rng, config.num_envs, probe=evaluating, axis=axis)
        updates = [functools.partial(update, env, config) for update in (pretrain, update_policy, update_discriminator)]
        before = state.replace(rng=None)
        after, metrics = jax.lax.switch(phase - PRETRAIN, [*updates, _leave], before, trajectory, update_rng)
        after = jax.tree.map(lambda new, old: jnp.where(trajectory.sound.any(), new, old), after, before)
        broken = 1.0 - trajectory.sound.mean()
        return after.replace(rng=rng), (
            mean_outcome(trajectory),
            _as_arrays(metrics),
            broken,
            trajectory.overflow.mean(),
        )

    return jax.lax.cond(phase == SKIP, skip, run, state)


def _leave(state: TrainState, trajectory, rng: jax.Array):
    """The update of an evaluation: none."""
    del trajectory, rng
    return state, _as_arrays(UpdateMetrics())


def _as_arrays(metrics):
    return jax.tree.map(lambda value: jnp.asarray(value, jnp.float32), metrics)


def _masked_mean(values: jax.Array, mask: jax.Array) -> jax.Array:
    return jnp.where(mask, values, 0.0).sum() / jnp.where(mask.any(), mask.sum(), jnp.nan)

"""The training step: one round of Algorithm 2 as a pure function.

A round is a row of phases, each of which is one roll-out and what is done with it. A scan over the phases runs them,
so the roll-out is traced and compiled once whatever the round holds, and `schedule` lists the rounds of a whole run:

    state, metrics = jax.lax.scan(functools.partial(train_step, env, config), state, schedule(config))
"""

import enum
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs import EpisodeMetrics, GoalEnv
from hgail_jax.config import Config
from hgail_jax.evaluate import mean_outcome
from hgail_jax.rollout import Trajectory, rollout
from hgail_jax.state import TrainState, split_key
from hgail_jax.updates import UpdateMetrics, make_policy, pretrain, update_discriminator, update_policy


class Phase(enum.IntEnum):
    """What is done with a roll-out."""

    SKIP = 0
    """Nothing; there is no roll-out either."""
    PRETRAIN = 1
    """Policy and discriminator are fitted to it (Algorithm 2, lines 1 to 3)."""
    POLICY = 2
    """PPO under the discriminator's reward (a g_step)."""
    DISCRIMINATOR = 3
    """The discriminator learns to tell it from expert samples (a d_step)."""
    EVALUATE = 4
    """The mean action is measured, and nothing is learnt."""


SKIP, PRETRAIN, POLICY, DISCRIMINATOR, EVALUATE = Phase
LEARNING = (PRETRAIN, POLICY, DISCRIMINATOR)
"""The phases that learn."""


def _learn_nothing(
    env: GoalEnv, config: Config, state: TrainState, trajectory: Trajectory, rng: jax.Array
) -> tuple[TrainState, UpdateMetrics]:
    del env, config, trajectory, rng
    return state, UpdateMetrics()


_UPDATES = {
    SKIP: _learn_nothing,
    PRETRAIN: pretrain,
    POLICY: update_policy,
    DISCRIMINATOR: update_discriminator,
    EVALUATE: _learn_nothing,
}


class PhaseMetrics(struct.PyTreeNode):
    """What a phase measured, all `[]`."""

    episodes: EpisodeMetrics
    update: UpdateMetrics
    dropped: jax.Array | float = 0.0
    """Share of the episodes whose simulation broke down."""
    overflow: jax.Array | float = 0.0
    """Share of the episodes whose simulation ran out of room for contacts."""
    diverged: jax.Array | float = 0.0
    """1 where the update was not finite, and was undone."""


class RoundMetrics(struct.PyTreeNode):
    """Means over the phases of a round, all `[]`; NaN where no phase of the round measured it."""

    evaluation: EpisodeMetrics
    """Episodes under the mean action."""
    training: EpisodeMetrics
    """Episodes under the stochastic policy."""
    update: UpdateMetrics
    dropped: jax.Array
    """Share of all episodes whose simulation broke down; nothing was learnt from them."""
    overflow: jax.Array
    """Share of all episodes whose simulation ran out of room for contacts: with more than 0 results are wrong."""
    diverged: jax.Array
    """Share of the updates that were not finite, and were undone."""


def schedule(config: Config) -> np.ndarray:
    """Returns the phases of a whole run, integers `[rounds + 1, phases]`.

    Row 0 is the pre-training, if there is one; every row ends with an evaluation.
    """
    updates = [POLICY] * config.policy_phases + [DISCRIMINATOR] * config.discriminator_phases
    first = [PRETRAIN if config.pretrain else SKIP] + [SKIP] * len(updates) + [EVALUATE]
    return np.array([first] + [[SKIP, *updates, EVALUATE]] * config.rounds)


def env_steps(env: GoalEnv, config: Config, phases: np.ndarray) -> np.ndarray:
    """Returns the environment steps that each row of a schedule learns from; evaluations do not count."""
    return np.isin(phases, LEARNING).sum(axis=-1) * config.num_envs * env.episode_length


def train_step(
    env: GoalEnv, config: Config, state: TrainState, phases: jax.Array | np.ndarray, axis: str | None = None
) -> tuple[TrainState, RoundMetrics]:
    """Runs one round. Pure: bind `env` and `config`, then jit, scan over a schedule, or vmap over states.

    What went wrong cannot be raised from within: `check_metrics` does so from what is returned.

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
    state, measured = jax.lax.scan(functools.partial(_run_phase, env, config, axis), state, phases)
    learns = jnp.isin(phases, jnp.array(LEARNING))

    def over(values: Any, mask: jax.Array) -> Any:
        return jax.tree.map(lambda leaf: _masked_mean(leaf, mask), values)

    return state, RoundMetrics(
        evaluation=over(measured.episodes, phases == EVALUATE),
        training=over(measured.episodes, learns),
        update=UpdateMetrics(
            **{
                name: over(values, jnp.isin(phases, jnp.array(MEASURED_BY[name])))
                for name, values in vars(measured.update).items()
            }
        ),
        dropped=over(measured.dropped, phases != SKIP),
        overflow=over(measured.overflow, phases != SKIP),
        diverged=over(measured.diverged, learns),
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


def check_metrics(metrics: RoundMetrics) -> None:
    """Refuses a round whose results are wrong.

    Args:
      metrics: leaves `[]` or, of several seeds, `[seeds]`.

    Raises:
      OverflowError: the simulation ran out of room for contacts.
      FloatingPointError: each seed had an update in the round that was not finite, or no episode whose simulation did
        not break down. Where a seed is sound the others go on: their updates were undone and are counted in
        `metrics.diverged`, or they learnt nothing, see `metrics.dropped`.

    """
    if np.any(np.asarray(metrics.overflow) > 0):
        raise OverflowError("the simulation ran out of room for contacts")
    diverged, broken = np.asarray(metrics.diverged) > 0, np.asarray(metrics.dropped) == 1
    if np.all(broken):
        raise FloatingPointError("the simulation of every episode broke down")
    if np.all(diverged | broken):
        raise FloatingPointError("no seed's update is finite")


def _run_phase(
    env: GoalEnv, config: Config, axis: str | None, state: TrainState, phase: jax.Array
) -> tuple[TrainState, PhaseMetrics]:
    def skip(state: TrainState) -> tuple[TrainState, PhaseMetrics]:
        return state, _as_arrays(PhaseMetrics(EpisodeMetrics(), UpdateMetrics()))

    def run(state: TrainState) -> tuple[TrainState, PhaseMetrics]:
        evaluating = phase == EVALUATE
        following_rng, phase_rng = jax.lax.cond(evaluating, _keys_of_evaluation, _keys_of_learning, state.rng)
        rollout_rng, update_rng = jax.random.split(phase_rng)
        policy = make_policy(env, config, state, noise=jnp.where(evaluating, 0.0, 1.0), axis=axis)
        exploring = ~evaluating if config.explore else False
        present = env.eased(jnp.where(evaluating, 1.0, state.progress(config)))
        trajectory = rollout(present, policy, rollout_rng, config.num_envs, exploring, probe=evaluating, axis=axis)
        after, metrics = _learn(env, config, phase, state.replace(rng=None), trajectory, update_rng)
        return after.replace(rng=following_rng), metrics

    return jax.lax.cond(phase == SKIP, skip, run, state)


def _keys_of_evaluation(rng: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the key of what follows an evaluation, and of the evaluation.

    The first is the key itself, so that an evaluation changes nothing in the training: the next phase splits it again,
    and takes other parts of it.
    """
    return jax.random.clone(rng), split_key(rng).evaluation


def _keys_of_learning(rng: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the key of what follows a phase that learns, and of the phase."""
    keys = split_key(rng)
    return keys.following, keys.phase


def _learn(
    env: GoalEnv, config: Config, phase: jax.Array, state: TrainState, trajectory: Trajectory, rng: jax.Array
) -> tuple[TrainState, PhaseMetrics]:
    """Returns the learner after a phase's update, or as it was where there is nothing sound to learn."""

    def branch(update: Any) -> Any:
        def run(state: TrainState, trajectory: Trajectory, rng: jax.Array) -> tuple[TrainState, UpdateMetrics]:
            learnt, metrics = update(env, config, state, trajectory, rng)
            return learnt, _as_arrays(metrics)

        return run

    learnt, metrics = jax.lax.switch(phase, [branch(_UPDATES[kind]) for kind in Phase], state, trajectory, rng)
    taught, finite = trajectory.sound.any(), _is_finite((learnt, metrics))
    after = jax.tree.map(lambda new, old: jnp.where(taught & finite, new, old), learnt, state)
    return after, _as_arrays(
        PhaseMetrics(
            episodes=mean_outcome(trajectory),
            update=metrics,
            dropped=1.0 - trajectory.sound.mean(),
            overflow=trajectory.overflow.mean(),
            diverged=taught & ~finite,
        )
    )


def _is_finite(tree: Any) -> jax.Array:
    """Returns whether all floating-point numbers of a tree are finite, a boolean `[]`."""
    floating = [leaf.ravel() for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    # Of one array: XLA would copy a chain over the leaves into each of the many places that need the result.
    return jnp.isfinite(jnp.concatenate(floating)).all()


def _as_arrays(metrics: Any) -> Any:
    return jax.tree.map(lambda value: jnp.asarray(value, jnp.float32), metrics)


def _masked_mean(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Returns the mean over the phases of `mask` that have a finite value; NaN where there is none."""
    mask = mask & jnp.isfinite(values)
    return jnp.where(mask, values, 0.0).sum() / jnp.where(mask.any(), mask.sum(), jnp.nan)

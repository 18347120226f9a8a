"""The training step: one round of Algorithm 2 as a pure function.

A round is a sequence of phases. Each makes one roll-out and uses it for one thing: to train the policy, to train the
discriminator, or to evaluate. A scan runs them, so that all share one compiled roll-out; `phase_table` lists the rounds
of a whole run:

    state, metrics = jax.lax.scan(functools.partial(train_step, env, config), state, phase_table(config))
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.acme import running_statistics, specs
from flax import struct

from hgail_envs import EpisodeMetrics, GoalEnv
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.discriminator import init_discriminator
from hgail_jax.evaluate import mean_outcome, measured_mean
from hgail_jax.experts import init_expert
from hgail_jax.learner import EVALUATE, LEARNING, SKIP, Phase
from hgail_jax.rollout import Policy, Trajectory, rollout
from hgail_jax.samples import Samples
from hgail_jax.state import TrainState, split_key

Metrics = dict[str, jax.Array]


def init_state(
    env: GoalEnv,
    config: Config,
    hyperparameters: Hyperparameters,
    rng: jax.Array,
    demonstrations: Samples | None = None,
) -> TrainState:
    """Returns the state of an untrained learner; `jax.vmap` it over `rng`, a PRNG key, for several seeds.

    Hyperparameters are tracers where a sweep is vmapped. The demonstrations, leaves `[S, ...]`, are given where the
    config's expert samples are demonstrations, and only there. See `Config.validate`, `Hyperparameters.validate` and
    `init_expert` for errors.
    """
    config.validate(env)
    hyperparameters.validate(env.action_size, config)
    *learner_rngs, discriminator_rng, rng = jax.random.split(rng, 4)
    discriminator, discriminator_optimizer = init_discriminator(env, config, discriminator_rng)
    return TrainState(
        learner=config.learner.init(env, config, jnp.stack(learner_rngs)),
        discriminator=discriminator,
        discriminator_optimizer=discriminator_optimizer,
        statistics=running_statistics.init_state(specs.Array((env.goal_observation_size,), jnp.dtype("float32"))),
        hyperparameters=hyperparameters.as_arrays(),
        rng=rng,
        expert=init_expert(env, config, demonstrations),
        buffer=config.learner.init_buffer(env),
    )


def make_policy(
    env: GoalEnv, config: Config, state: TrainState, noise: jax.Array | float, axis: str | None = None
) -> Policy:
    """Returns the policy of `state`, to be rolled out; see `Learner.policy`."""
    return config.learner.policy(env, config, state, noise, axis)


class PhaseMetrics(struct.PyTreeNode):
    """Measurements of a phase, all `[]`."""

    episodes: EpisodeMetrics
    update: Metrics
    """By the names of `Learner.metrics`; infinite where the phase does not measure it."""
    dropped: jax.Array | float = 0.0
    """Fraction of the episodes whose simulation broke down."""
    overflow: jax.Array | float = 0.0
    """Fraction of the episodes whose simulation ran out of room for contacts."""
    diverged: jax.Array | float = 0.0
    """1 where the update was not finite, and was undone."""


class RoundMetrics(struct.PyTreeNode):
    """Means over the phases of a round, all `[]`; infinite where no phase of the round measured it."""

    evaluation: EpisodeMetrics
    """Episodes under the mean action."""
    training: EpisodeMetrics
    """Episodes under the stochastic policy."""
    update: Metrics
    """By the names of `Learner.metrics`."""
    dropped: jax.Array
    """Fraction of all episodes whose simulation broke down; nothing was learnt from them."""
    overflow: jax.Array
    """Fraction of all episodes whose simulation ran out of room for contacts: with more than 0 results are wrong."""
    diverged: jax.Array
    """Fraction of the updates that were not finite, and were undone."""


def phase_table(config: Config) -> np.ndarray:
    """Returns the phases of a whole run, integers `[rounds + 1, phases]`; see `Learner.phase_table`."""
    return config.learner.phase_table(config)


def env_steps(env: GoalEnv, config: Config, phases: np.ndarray) -> np.ndarray:
    """Returns the environment steps that each row of a table of phases learns from; evaluations do not count."""
    return np.isin(phases, LEARNING).sum(axis=-1) * config.num_envs * env.episode_length


def train_step(
    env: GoalEnv, config: Config, state: TrainState, phases: jax.Array | np.ndarray, axis: str | None = None
) -> tuple[TrainState, RoundMetrics]:
    """Runs one round. Pure: bind `env` and `config`, then jit, scan over a table of phases, or vmap over states.

    The state is from `init_state` or an earlier step. The phases, `[phases]`, are a row of `phase_table`; under a vmap
    over states leave them unbatched, so that a phase runs its own update and no other. See `rollout` for `axis`. Errors
    cannot be raised from within: `check_metrics` raises them from the metrics.
    """
    phases = jnp.asarray(phases)
    state, measured = jax.lax.scan(functools.partial(_run_phase, env, config, axis), state, phases)
    learns = jnp.isin(phases, jnp.array(LEARNING))

    def over(values: Any, mask: jax.Array) -> Any:
        return jax.tree.map(lambda leaf: measured_mean(leaf, mask), values)

    return state, RoundMetrics(
        evaluation=over(measured.episodes, phases == EVALUATE),
        training=over(measured.episodes, learns),
        update=over(measured.update, learns),
        dropped=over(measured.dropped, phases != SKIP),
        overflow=over(measured.overflow, phases != SKIP),
        diverged=over(measured.diverged, learns),
    )


def check_metrics(metrics: RoundMetrics) -> None:
    """Refuses a round whose results are wrong; leaves of the metrics are `[]` or, of several seeds, `[seeds]`.

    Raises:
      OverflowError: the simulation ran out of room for contacts.
      FloatingPointError: each seed had an update in the round that was not finite, or no episode whose simulation did
        not break down. Where a seed is sound the others continue: their updates were undone and are counted in
        `metrics.diverged`, or they learnt nothing, see `metrics.dropped`.
    """
    # Infinite is not measured: a round that learns nothing, as the first without a pre-training, has no divergence.
    overflow, diverged = (
        (rate > 0) & (rate < np.inf) for rate in map(np.asarray, (metrics.overflow, metrics.diverged))
    )
    if np.any(overflow):
        raise OverflowError("the simulation ran out of room for contacts")
    broken = np.asarray(metrics.dropped) == 1
    if np.all(broken):
        raise FloatingPointError("the simulation of every episode broke down")
    if np.all(diverged | broken):
        raise FloatingPointError("no seed's update is finite")


def _run_phase(
    env: GoalEnv, config: Config, axis: str | None, state: TrainState, phase: jax.Array
) -> tuple[TrainState, PhaseMetrics]:
    def skip(state: TrainState) -> tuple[TrainState, PhaseMetrics]:
        return state, _as_arrays(PhaseMetrics(EpisodeMetrics(), _named(config, {})))

    def run(state: TrainState) -> tuple[TrainState, PhaseMetrics]:
        evaluating = phase == EVALUATE
        following_rng, phase_rng = jax.lax.cond(evaluating, _keys_of_evaluation, _keys_of_learning, state.rng)
        rollout_rng, update_rng = jax.random.split(phase_rng)
        policy = config.learner.policy(env, config, state, noise=jnp.where(evaluating, 0.0, 1.0), axis=axis)
        training_goals = ~evaluating if config.training_goals else False
        present = env.curriculum(jnp.where(evaluating, 1.0, config.learner.progress(config, state)))
        detour = config.learner.detour(env, config, state, jax.random.fold_in(phase_rng, 2))
        if detour is not None:
            detour = detour._replace(until=jnp.where(evaluating, 0, detour.until))
        trajectory = rollout(
            present,
            policy,
            rollout_rng,
            config.num_envs,
            training_goals,
            lift_test=evaluating,
            axis=axis,
            detour=detour,
        )
        after, metrics = _learn(env, config, phase, state.replace(rng=None), trajectory, update_rng)
        return after.replace(rng=following_rng), metrics

    return jax.lax.cond(phase == SKIP, skip, run, state)


def _keys_of_evaluation(rng: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the key after an evaluation, which is the key itself, and the key of the evaluation.

    So an evaluation changes nothing in the training: the next phase splits the key again, and takes other parts of it.
    """
    return jax.random.clone(rng), split_key(rng).evaluation


def _keys_of_learning(rng: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the key after a phase that learns, and the key of the phase."""
    keys = split_key(rng)
    return keys.following, keys.phase


def _learn(
    env: GoalEnv, config: Config, phase: jax.Array, state: TrainState, trajectory: Trajectory, rng: jax.Array
) -> tuple[TrainState, PhaseMetrics]:
    """Returns the learner after a phase's update, or as it was where there is nothing valid to learn."""
    occurring = phase_table(config)  # an update that no round makes need not be compiled
    updates = {kind: update for kind, update in config.learner.phase_updates().items() if kind in occurring}

    def branch(kind: Phase) -> Any:
        def run(state: TrainState, trajectory: Trajectory, rng: jax.Array) -> tuple[TrainState, Metrics, jax.Array]:
            learnt, metrics = updates[kind](env, config, state, trajectory, rng) if kind in updates else (state, {})
            return learnt, _named(config, metrics), _is_finite((learnt.replace(buffer=None), metrics))

        return run

    learnt, metrics, finite = jax.lax.switch(phase, [branch(kind) for kind in Phase], state, trajectory, rng)
    taught = trajectory.valid.any()
    after = jax.tree.map(lambda new, old: jnp.where(taught & finite, new, old), learnt, state)
    if (noted := getattr(learnt.buffer, "noted", None)) is not None:
        # It may be gigabytes, so it is not copied to be undone. The next roll-out replaces the same episodes first.
        after = after.replace(buffer=after.buffer.replace(noted=noted))
    return after, _as_arrays(
        PhaseMetrics(
            episodes=mean_outcome(trajectory),
            update=metrics,
            dropped=1.0 - trajectory.valid.mean(),
            overflow=trajectory.overflow.mean(),
            diverged=taught & ~finite,
        )
    )


def _is_finite(tree: Any) -> jax.Array:
    """Returns whether all floating-point numbers of a tree are finite, a boolean `[]`."""
    floating = [leaf.ravel() for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    # Of one array: XLA would copy a chain over the leaves into each of the many places that need the result.
    return jnp.isfinite(jnp.concatenate(floating)).all()


def _named(config: Config, metrics: Metrics) -> Metrics:
    """Returns a number for each of the learner's metrics, infinity for those that were not measured."""
    names = config.learner.metrics
    return {name: jnp.asarray(metrics.get(name, jnp.inf), jnp.float32) for name in names}


def _as_arrays(metrics: Any) -> Any:
    return jax.tree.map(lambda value: jnp.asarray(value, jnp.float32), metrics)

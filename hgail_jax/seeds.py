"""Trains several seeds, and several settings of the hyperparameters, side by side in one compiled program."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hgail_envs import EpisodeMetrics, GoalEnv
from hgail_envs.validation import MOST_SEED, check_count, counted
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.devices.compilation import compile_lowered, compile_program, lower_program
from hgail_jax.devices.sharding import ALONG_SEEDS, REPLICATED, jit_per_device
from hgail_jax.evaluate import evaluate_rollouts, whole_rollouts
from hgail_jax.samples import Samples
from hgail_jax.state import TrainState, split_key
from hgail_jax.train import RoundMetrics, init_state, make_policy, train_step

SeedsStep = Callable[[TrainState, np.ndarray], tuple[TrainState, RoundMetrics]]
"""A compiled function of states and a row of phases to new states and metrics, all with an axis over seeds."""
SeedsEvaluation = Callable[[TrainState], EpisodeMetrics]
"""A compiled function of states to how their episodes ended, all with an axis over seeds."""


def check_seeds(first: int, count: int) -> None:
    """Raises a ValueError if there are no seeds, or some are negative or wider than 31 bits."""
    check_count("seeds", count)
    check_count("first_seed", first, least=0, most=MOST_SEED - count)


def seed_keys(first: int, count: int) -> jax.Array:
    """Returns the PRNG keys of the seeds `first` to `first + count - 1`; a seed's run does not depend on the others."""
    check_seeds(first, count)
    return jax.vmap(jax.random.key)(jnp.arange(first, first + count))


def init_seeds(
    env: GoalEnv,
    config: Config,
    hyperparameters: Hyperparameters,
    keys: jax.Array,
    demonstrations: Samples | None = None,
) -> TrainState:
    """Returns a state whose every leaf has a leading axis over `keys`, `[seeds]`; see `init_state`."""
    return init_sweep(env, config, [hyperparameters], keys, demonstrations)


def init_sweep(
    env: GoalEnv,
    config: Config,
    settings: Sequence[Hyperparameters],
    keys: jax.Array,
    demonstrations: Samples | None = None,
) -> TrainState:
    """Returns a state whose every leaf has a leading axis over settings times seeds, the seeds within a setting.

    Whatever trains several seeds trains this: a grid of settings is one program, with one `config`. Every setting has
    the same seeds, `[seeds]` keys. `split_sweep` takes its results apart; see `init_state` for the rest, and errors.
    """
    check_count("the number of settings", len(settings))
    for setting in settings:  # while they are being traced they have no values
        setting.validate(env.action_size, config)
    arrays = [setting.as_arrays() for setting in settings]
    swept = jax.tree.map(lambda *values: jnp.repeat(jnp.stack(values), len(keys), axis=0), *arrays)
    init = functools.partial(init_state, env, config, demonstrations=demonstrations)
    jitted, tiled = jax.jit(jax.vmap(init)), jnp.tile(keys, len(settings))
    if isinstance(tiled, jax.core.Tracer):  # within another program, or where shapes alone are asked for
        return jitted(swept, tiled)
    return compile_program(jitted, swept, tiled)(swept, tiled)


def split_sweep(results: Any, settings: int) -> Any:
    """Returns `results`, any pytree with leaves `[settings * seeds, ...]`, with leaves `[settings, seeds, ...]`."""
    return jax.tree.map(lambda leaf: leaf.reshape(settings, -1, *leaf.shape[1:]), results)


def compile_train_step(
    env: GoalEnv, config: Config, states: TrainState, phases: np.ndarray, mesh: Mesh | None = None
) -> SeedsStep:
    """Compiles `train_step` for all seeds at once. The step consumes the states that it is given.

    Of the states, from `init_seeds`, and of a row of `phase_table` only the shapes are read. With a mesh of several
    devices, from `make_mesh`, each runs its part, see `hgail_jax.devices.sharding`. The step then takes states that
    `shard` placed, and every process can read its metrics.

    Raises:
      ValueError: a device would step more environments than the task's physics can.
    """
    _check_worlds(env, config, states, mesh)

    def step(axis: str | None, states: TrainState, phases: jax.Array) -> tuple[TrainState, RoundMetrics]:
        return jax.vmap(functools.partial(train_step, env, config, axis=axis), in_axes=(0, None))(states, phases)

    jitted = jit_per_device(mesh, step, (ALONG_SEEDS, REPLICATED), (ALONG_SEEDS, REPLICATED), donate_argnums=0)
    return compile_program(jitted, states, phases, tuned=config.learner.convolves)


def _check_worlds(env: GoalEnv, config: Config, states: TrainState, mesh: Mesh | None) -> None:
    on_a_device = len(states.rng) * config.num_envs // (1 if mesh is None else mesh.size)
    if env.max_worlds is not None and on_a_device > env.max_worlds:
        raise ValueError(
            f"{counted(len(states.rng), 'seed')} of {counted(config.num_envs, 'environment')} make {on_a_device} on a"
            f" device; the task was made for {env.max_worlds}: make it with worlds={on_a_device}"
        )


def evaluate_seeds(
    env: GoalEnv, config: Config, states: TrainState, num_episodes: int, mesh: Mesh | None = None
) -> EpisodeMetrics:
    """Evaluates every seed once; see `trace_evaluation` for arguments, result and errors."""
    return trace_evaluation(env, config, states, num_episodes, mesh)()(states)


def trace_evaluation(
    env: GoalEnv, config: Config, states: TrainState, num_episodes: int, mesh: Mesh | None = None
) -> Callable[[], SeedsEvaluation]:
    """Traces the evaluation of every seed's mean action in the task's reference physics.

    Each seed has `num_episodes` at least, in whole roll-outs. See `compile_train_step` for the other arguments.

    Returns:
      A function that compiles, which needs the device no more, and returns a function of states, with a mesh as `shard`
      placed them, to the means over the episodes, `[seeds]`. That raises an OverflowError if the simulation runs out of
      room for contacts.

    Raises:
      ValueError: `num_episodes` is no count from 1; or see `compile_train_step`.
    """
    _check_worlds(env, config, states, mesh)
    reference, rollouts = env.reference_physics(), whole_rollouts(num_episodes, config.num_envs)

    def measure(axis: str | None, states: TrainState) -> tuple[EpisodeMetrics, jax.Array]:
        def of_seed(state: TrainState) -> tuple[EpisodeMetrics, jax.Array]:
            policy = make_policy(reference, config, state, noise=0.0, axis=axis)
            rng = split_key(state.rng).final_evaluation
            return evaluate_rollouts(reference, policy, rng, rollouts, config.num_envs, axis)

        return jax.vmap(of_seed)(states)

    lowered = lower_program(jit_per_device(mesh, measure, (ALONG_SEEDS,), REPLICATED), states)

    def compile_evaluation() -> SeedsEvaluation:
        compiled = compile_lowered(lowered, config.learner.convolves)

        def evaluate(states: TrainState) -> EpisodeMetrics:
            outcome, overflow = jax.tree.map(np.asarray, compiled(states))
            if overflow.any():
                raise OverflowError("the simulation ran out of room for contacts in the final evaluation")
            return outcome

        return evaluate

    return compile_evaluation

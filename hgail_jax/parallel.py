"""Trains several seeds, and several settings of the hyperparameters, side by side in one compiled program."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding

from envs import GoalEnv
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.evaluate import EpisodeMetrics
from hgail_jax.samples import Samples
from hgail_jax.sharding import ALONG_SEEDS, ENVS, EVERYWHERE, per_device
from hgail_jax.state import TrainState, init_state
from hgail_jax.train import RoundMetrics, final_evaluation, train_step
from hgail_jax.validation import check_count

_MOST_SEEDS = 2**31 - 1

SeedsStep = Callable[[TrainState, np.ndarray], tuple[TrainState, RoundMetrics]]
"""A compiled function of states and a row of phases to new states and metrics, all with an axis over seeds."""


def check_seeds(first: int, count: int) -> None:
    """Raises a ValueError if there are no seeds, or some are negative or wider than 31 bits."""
    check_count("seeds", count)
    check_count("first_seed", first, least=0, most=_MOST_SEEDS - count)


def seed_keys(first: int, count: int) -> jax.Array:
    """Returns the PRNG keys of the seeds `first` to `first + count - 1`; a seed's run does not depend on the others.

    Raises:
      ValueError: see `check_seeds`.

    """
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

    Whatever trains several seeds trains this: a grid of settings is one program. `split_sweep` takes its results apart.

    Args:
      env: the task.
      config: sizes and counts, which all settings share.
      settings: the hyperparameters of each.
      keys: `[seeds]`; every setting has the same seeds.
      demonstrations: see `init_state`.

    Raises:
      ValueError: see `init_state`; or there is no setting.

    """
    check_count("the number of settings", len(settings))
    for setting in settings:  # once they are being traced, nobody can see them
        setting.validate()
    swept = jax.tree.map(lambda *values: jnp.stack([jnp.asarray(value) for value in values]), *map(_widen, settings))
    swept = jax.tree.map(lambda values: jnp.repeat(values, len(keys), axis=0), swept)
    init = functools.partial(init_state, env, config, demonstrations=demonstrations)
    return jax.jit(jax.vmap(init))(swept, jnp.tile(keys, len(settings)))


def _widen(setting: Hyperparameters) -> Hyperparameters:
    """Returns the setting with arrays for leaves."""
    return Hyperparameters(**{name: jnp.asarray(value) for name, value in vars(setting).items()})


def split_sweep(results: Any, settings: int) -> Any:
    """Returns `results`, any pytree with leaves `[settings * seeds, ...]`, with leaves `[settings, seeds, ...]`."""
    return jax.tree.map(lambda leaf: leaf.reshape(settings, -1, *leaf.shape[1:]), results)


def compile_train_step(
    env: GoalEnv, config: Config, states: TrainState, phases: np.ndarray, mesh: Mesh | None = None
) -> SeedsStep:
    """Compiles `train_step` for all seeds at once. The step consumes the states that it is given.

    With a mesh of several devices each runs its part, see `hgail_jax.sharding`. The step then takes states that
    `spread` placed, and every process can read its metrics.

    On a GPU it compiles without autotuning and at a low optimisation level: the program is thousands of small kernels,
    and on an H200 this took a third off the compilation and nothing off the speed.

    Args:
      env: the task.
      config: sizes and counts.
      states: from `init_seeds`; only its shapes are read.
      phases: any row of the schedule; only its shape is read.
      mesh: from `make_mesh`; None is one device.

    Returns:
      A function of states and a row of phases to new states and metrics, each with an axis over seeds.

    """
    return _jit_train_step(env, config, mesh).lower(states, phases).compile(compiler_options=compiler_options())


def compiler_options() -> dict[str, Any] | None:
    """Returns the options that programs with physics in them are compiled with on this platform."""
    if jax.default_backend() != "gpu":
        return None
    return {"xla_gpu_autotune_level": 0, "xla_backend_optimization_level": 1}


def _jit_train_step(env: GoalEnv, config: Config, mesh: Mesh | None) -> Any:
    def step(axis, states, phases):
        return jax.vmap(functools.partial(train_step, env, config, axis=axis), in_axes=(0, None))(states, phases)

    if mesh is None or mesh.size == 1:
        return jax.jit(functools.partial(step, None), donate_argnums=0)
    axis = ENVS if mesh.shape[ENVS] > 1 else None
    sharded = per_device(functools.partial(step, axis), mesh, (ALONG_SEEDS, EVERYWHERE), (ALONG_SEEDS, ALONG_SEEDS))
    along_seeds, everywhere = NamedSharding(mesh, ALONG_SEEDS), NamedSharding(mesh, EVERYWHERE)
    return jax.jit(
        sharded, in_shardings=(along_seeds, everywhere), out_shardings=(along_seeds, everywhere), donate_argnums=0
    )


def evaluate_seeds(
    step: SeedsStep, config: Config, states: TrainState, num_episodes: int
) -> tuple[TrainState, EpisodeMetrics]:
    """Evaluates every seed's mean action in the task's most accurate physics, with the compiled `step`.

    Consumes the states; returns them as they were but for their keys, and the means over the episodes, `[seeds]`. There
    are at least `num_episodes` episodes per seed: whole roll-outs.

    Raises:
      OverflowError: the simulation ran out of room for contacts.

    """
    measured, weights = [], []
    for phases in final_evaluation(config, num_episodes):
        states, metrics = step(states, phases)
        if np.any(np.asarray(metrics.overflow) > 0):
            raise OverflowError("the simulation ran out of room for contacts in the final evaluation")
        measured.append(metrics.evaluation)
        weights.append(np.count_nonzero(phases))
    return states, jax.tree.map(lambda *means: np.average(means, axis=0, weights=weights), *measured)


def evaluation_episodes(config: Config, num_episodes: int) -> int:
    """Returns how many episodes per seed `evaluate_seeds` runs: `num_episodes`, rounded up to whole roll-outs."""
    return int(np.count_nonzero(final_evaluation(config, num_episodes))) * config.num_envs

"""Trains several seeds side by side in one compiled program."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from envs import GoalEnv
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.evaluate import EpisodeMetrics, evaluate
from hgail_jax.state import TrainState, init_state
from hgail_jax.train import RoundMetrics, train_step
from hgail_jax.updates import act

SeedsStep = Callable[[TrainState, np.ndarray], tuple[TrainState, RoundMetrics]]
SeedsEvaluation = Callable[[TrainState, jax.Array], EpisodeMetrics]


def seed_keys(first: int, count: int) -> jax.Array:
    """Returns the PRNG keys of the seeds `first` to `first + count - 1`; a seed's run does not depend on the others."""
    return jax.vmap(jax.random.key)(jnp.arange(first, first + count))


def init_seeds(env: GoalEnv, config: Config, hyperparameters: Hyperparameters, keys: jax.Array) -> TrainState:
    """Returns a state whose every leaf has a leading axis over `keys`, `[seeds]`."""
    return jax.jit(jax.vmap(functools.partial(init_state, env, config, hyperparameters)))(keys)


def compile_train_step(env: GoalEnv, config: Config, states: TrainState, phases: np.ndarray) -> SeedsStep:
    """Compiles `train_step` for all seeds at once. The step consumes the states that it is given.

    Args:
      env: the task.
      config: sizes and counts.
      states: from `init_seeds`; only its shapes are read.
      phases: any row of the schedule; only its shape is read.

    Returns:
      A function of states and a row of phases to new states and metrics, each with an axis over seeds.

    """
    step = jax.vmap(functools.partial(train_step, env, config), in_axes=(0, None))
    return jax.jit(step, donate_argnums=0).lower(states, phases).compile()


def compile_evaluation(env: GoalEnv, config: Config, states: TrainState, num_episodes: int) -> SeedsEvaluation:
    """Compiles the evaluation of every seed's mean action over `num_episodes` fresh episodes.

    Returns:
      A function of states and PRNG keys, `[seeds]`, to metrics with an axis over seeds.

    """

    def evaluate_one(state: TrainState, rng: jax.Array) -> EpisodeMetrics:
        return evaluate(env, act(env, config, state, noise=0.0), rng, num_episodes)

    return jax.jit(jax.vmap(evaluate_one)).lower(states, states.rng).compile()

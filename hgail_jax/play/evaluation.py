"""Measures the success of trained policies in their task's reference physics."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hgail_envs import EpisodeMetrics, GoalEnv
from hgail_jax.devices.compilation import compile_program
from hgail_jax.evaluate import evaluate_rollouts, whole_rollouts
from hgail_jax.policy import MeanPolicy, mean_action

_MOST_AT_ONCE = 512  # episodes side by side


class Evaluation:
    """Evaluates mean actions in a task's most accurate physics, as a run evaluates its seeds at its end.

    Policies of one shape, as the seeds of a run are, share a compiled program. Each has `num_episodes` at least, a
    count from 1: whole roll-outs of equal size.
    """

    def __init__(self, env: GoalEnv, seed: int, num_episodes: int) -> None:
        self._env, self._rng = env.reference_physics(), jax.random.key(seed)
        self._rollouts = whole_rollouts(num_episodes, min(_MOST_AT_ONCE, env.max_worlds or _MOST_AT_ONCE))
        self._num_envs = whole_rollouts(num_episodes, self._rollouts)
        self.episodes = self._rollouts * self._num_envs
        """Episodes that a policy has."""
        self._programs: dict[Any, Any] = {}

    def __call__(self, policy: MeanPolicy) -> EpisodeMetrics:
        """Returns the means over the episodes, plain numbers; an OverflowError if contacts ran out of room."""
        arrays = (policy.mean, policy.std, policy.layers)
        shape = policy.squash, str(jax.tree.map(np.shape, arrays))
        if shape not in self._programs:
            measure = jax.jit(functools.partial(self._measure, policy.squash))
            self._programs[shape] = compile_program(measure, arrays, self._rng)
        outcome, overflow = self._programs[shape](arrays, self._rng)
        if overflow:
            raise OverflowError("the simulation ran out of room for contacts in the evaluation")
        return jax.tree.map(float, outcome)

    def _measure(self, squash: bool, arrays: Any, rng: jax.Array) -> tuple[EpisodeMetrics, jax.Array]:
        mean, std, layers = arrays

        def act(observation: Any, rng: jax.Array) -> tuple[Any, jax.Array]:
            return mean_action(mean, std, layers, squash, observation, jnp), jnp.zeros(len(observation))

        return evaluate_rollouts(self._env, act, rng, self._rollouts, self._num_envs)

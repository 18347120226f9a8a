"""Measures the success of trained policies in their task's reference physics."""

import functools
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from hgail_envs import EpisodeMetrics, GoalEnv
from hgail_jax.devices.compilation import compile_program
from hgail_jax.evaluate import evaluate_rollouts, whole_rollouts
from hgail_jax.io.policy import AnyPolicy
from hgail_jax.policy import MeanPolicy, mean_action
from hgail_jax.vision.policy import CameraPolicy, act_in

_MOST_AT_ONCE = 512  # episodes side by side


class Evaluation:
    """Evaluates mean actions in a task's reference physics, as a run evaluates its seeds at its end.

    Policies of one shape, as the seeds of a run are, share a compiled program. Each has `num_episodes` at least, a
    count from 1: whole roll-outs of equal size.
    """

    def __init__(self, env: GoalEnv, seed: int, num_episodes: int) -> None:
        self._env, self._rng = env.reference_physics(), jax.random.key(seed)
        self._env.prepare()
        self._rollouts = whole_rollouts(num_episodes, min(_MOST_AT_ONCE, env.max_worlds or _MOST_AT_ONCE))
        self._num_envs = whole_rollouts(num_episodes, self._rollouts)
        self.episodes = self._rollouts * self._num_envs
        """Episodes that a policy has."""
        self._programs: dict[Any, Any] = {}

    def __call__(self, policy: AnyPolicy) -> EpisodeMetrics:
        """Returns the means over the episodes, plain numbers; an OverflowError if contacts ran out of room."""
        arrays: Any = policy.parameters() if isinstance(policy, CameraPolicy) else _arrays(policy)
        shape = type(policy), getattr(policy, "squash", True), str(jax.tree.map(np.shape, arrays))
        if shape not in self._programs:
            measure = jax.jit(functools.partial(self._measure, self._action(policy)))
            self._programs[shape] = compile_program(measure, arrays, self._rng, tuned=isinstance(policy, CameraPolicy))
        outcome, overflow = self._programs[shape](arrays, self._rng)
        if overflow:
            raise OverflowError("the simulation ran out of room for contacts in the evaluation")
        return jax.tree.map(float, outcome)

    def _action(self, policy: AnyPolicy) -> Callable[[Any, jax.Array], jax.Array]:
        """Returns the function of a policy's arrays and a batch of observations to actions."""
        if isinstance(policy, CameraPolicy):
            return functools.partial(act_in, self._env)
        squash = policy.squash

        def act(arrays: Any, observation: jax.Array) -> jax.Array:
            mean, std, layers = arrays
            return cast(jax.Array, mean_action(mean, std, layers, squash, observation, jnp))

        return act

    def _measure(
        self, action: Callable[[Any, jax.Array], jax.Array], arrays: Any, rng: jax.Array
    ) -> tuple[EpisodeMetrics, jax.Array]:
        def act(observation: jax.Array, rng: jax.Array) -> tuple[jax.Array, None]:
            return action(arrays, observation), None

        return evaluate_rollouts(self._env, act, rng, self._rollouts, self._num_envs)


def _arrays(policy: MeanPolicy) -> Any:
    return policy.mean, policy.std, policy.layers

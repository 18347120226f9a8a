"""The one evaluation: episodes of a policy, and the means of how they ended."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hgail_envs import EpisodeMetrics, GoalEnv
from hgail_envs.validation import check_count
from hgail_jax.devices.compilation import compile_program
from hgail_jax.policy import MeanPolicy, mean_action
from hgail_jax.rollout import Policy, Trajectory, rollout

_MOST_AT_ONCE = 512  # episodes side by side


def mean_outcome(trajectory: Trajectory) -> EpisodeMetrics:
    """Returns the means over a trajectory's episodes, `[]`.

    An episode whose simulation broke down counts as a failure, and in no distance; where all did, the distances are
    infinite.
    """
    outcome, valid = trajectory.outcome, trajectory.valid
    distances = {name: measured_mean(getattr(outcome, name), valid) for name in ("distance_l1", "distance_l2")}
    return jax.tree.map(jnp.mean, outcome).replace(**distances)


def measured_mean(values: jax.Array, measured: jax.Array) -> jax.Array:
    """Returns the mean, `[]`, of the finite values that were measured, `[N]`; infinity where none was.

    It is not NaN there, so that `jax_debug_nans` finds only what is wrong.
    """
    measured = measured & jnp.isfinite(values)
    count = measured.sum().astype(values.dtype)
    return jnp.where(count > 0, jnp.where(measured, values, 0.0).sum() / jnp.maximum(count, 1.0), jnp.inf)


def evaluate(env: GoalEnv, policy: Policy, rng: jax.Array, num_episodes: int) -> EpisodeMetrics:
    """Runs `policy` for `num_episodes` fresh episodes side by side, with the task's lift test; jit it.

    Returns the means over the episodes, `[]`. It does not say whether the simulation ran out of room for contacts;
    `hgail_jax.seeds.evaluate_seeds` raises an error then.
    """
    return mean_outcome(rollout(env, policy, rng, num_episodes, lift_test=True))


def evaluate_rollouts(
    env: GoalEnv, policy: Policy, rng: jax.Array, rollouts: int, num_envs: int, axis: str | None = None
) -> tuple[EpisodeMetrics, jax.Array]:
    """Runs `policy` for some roll-outs of `num_envs` episodes, one after another.

    Args:
      env: the task.
      policy: to be evaluated.
      rng: a PRNG key.
      rollouts: their number.
      num_envs: episodes side by side in each.
      axis: see `rollout`.

    Returns:
      The means over all episodes, `[]`, and whether the simulation ran out of room for contacts, a boolean `[]`.

    """

    def roll_out(rng: jax.Array) -> tuple[EpisodeMetrics, jax.Array]:
        trajectory = rollout(env, policy, rng, num_envs, lift_test=True, axis=axis)
        return mean_outcome(trajectory), trajectory.overflow.any()

    outcomes, overflow = jax.lax.map(roll_out, jax.random.split(rng, rollouts))
    # A roll-out in which every episode broke has no distance; the others have the mean one.
    return jax.tree.map(lambda values: measured_mean(values, jnp.ones(rollouts, bool)), outcomes), overflow.any()


class Evaluation:
    """Evaluates mean actions in a task's most accurate physics, as a run evaluates its seeds at its end.

    Policies of one shape, as the seeds of a run are, share a compiled program.

    Args:
      env: the task, of the policies' sizes.
      seed: of the episodes.
      num_episodes: least number of episodes: whole roll-outs of equal size.

    Raises:
      ValueError: `num_episodes` is no count from 1.

    """

    def __init__(self, env: GoalEnv, seed: int, num_episodes: int) -> None:
        self._env, self._rng = env.reference_physics(), jax.random.key(seed)
        self._rollouts = whole_rollouts(num_episodes, min(_MOST_AT_ONCE, env.max_worlds or _MOST_AT_ONCE))
        self._num_envs = whole_rollouts(num_episodes, self._rollouts)
        self.episodes = self._rollouts * self._num_envs
        """Episodes that a policy has."""
        self._programs: dict[Any, Any] = {}

    def __call__(self, policy: MeanPolicy) -> EpisodeMetrics:
        """Returns the means over the episodes of a policy, plain numbers.

        Raises:
          OverflowError: the simulation ran out of room for contacts.

        """
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


def whole_rollouts(num_episodes: int, num_envs: int) -> int:
    """Returns how many roll-outs of `num_envs` episodes have at least `num_episodes`.

    Raises:
      ValueError: `num_episodes` is no count from 1.

    >>> whole_rollouts(100, 64)
    2

    """
    check_count("num_episodes", num_episodes)
    return -(-num_episodes // num_envs)

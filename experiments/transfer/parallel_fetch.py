"""Measures policies on this project's Fetch, all episodes of a point at once on C MuJoCo."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hgail_envs
from hgail_envs import EpisodeMetrics
from hgail_envs.randomization import Randomization
from hgail_envs.randomized import RandomizedEnv
from hgail_jax.io.policy import MeanPolicy, mean_action
from hgail_jax.rollout import rollout

NAME = "This package's Fetch, C MuJoCo"
"""Name of this robot in the rows of tables."""

_MOST = Randomization(  # upper bounds of the points below, for which the program is compiled
    delay=(0, 4),
    robot_noise=1.0,
    object_noise=1.0,
    goal_noise=1.0,
    friction=(0.5, 1.5),
    hand_opening=1.0,
)
_SIZES = tuple(name for name in vars(_MOST) if name not in ("posture", "history", "ramp"))


class ParallelFetch:
    """A Fetch task with randomised episodes, and policies for it that take turns.

    Args:
      task: a Fetch task's name.
      policies: with the same network sizes and the same history.
      episodes: of a point; all points have the same starts.
      seed: of the episodes.

    """

    def __init__(self, task: str, policies: Sequence[MeanPolicy], episodes: int, seed: int) -> None:
        history = policies[0].randomization.history
        most = Randomization(**{**vars(_MOST), "history": history})
        env = RandomizedEnv(hgail_envs.make(task, impl="c"), most)
        turns = np.arange(episodes) % len(policies)
        parts = [(policy.mean, policy.std, policy.layers) for policy in policies]
        stacked = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)[turns]), *parts)

        def mean_action_of(mean: Any, std: Any, layers: Any, observation: jax.Array) -> jax.Array:
            return mean_action(mean, std, layers, policies[0].squash, observation, xp=jnp)

        def act(observation: jax.Array, rng: jax.Array) -> tuple[jax.Array, jax.Array]:
            del rng
            mean, std, layers = stacked
            action = jax.vmap(mean_action_of)(mean, std, layers, observation)
            return action, jnp.zeros(episodes)

        def run(sizes: Mapping[str, Any], rng: jax.Array) -> EpisodeMetrics:
            return rollout(env.with_sizes(sizes), act, rng, episodes, lift_test=True).outcome

        self._run: Callable[..., EpisodeMetrics] = jax.jit(run)
        self._rng = jax.random.key(seed)

    def outcomes(self, **sizes: Any) -> EpisodeMetrics:
        """Returns the outcomes of a point's episodes, leaves `[episodes]`.

        Args:
          **sizes: fields of `Randomization` but `posture`, `history` and `ramp`; the others are nominal.

        """
        unknown = set(sizes) - set(_SIZES)
        if unknown:
            raise ValueError(f"a point cannot have {min(unknown)!r}; it may have {', '.join(_SIZES)}")
        point = vars(Randomization(**sizes))
        return jax.tree.map(np.asarray, self._run({name: point[name] for name in _SIZES}, self._rng))

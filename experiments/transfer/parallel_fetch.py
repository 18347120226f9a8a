"""Measures policies on this project's Fetch, all episodes of a point at once on C MuJoCo."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hgail_envs
from experiments.transfer.episode import tracks_cube
from hgail_envs import EpisodeMetrics
from hgail_envs.randomization import Randomization
from hgail_envs.randomized import RandomizedEnv
from hgail_envs.variation import SOURCES, Drawn, RandomizedPhysics
from hgail_jax.policy import MeanPolicy, mean_action
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
_SIZES = tuple(name for name in vars(_MOST) if name not in ("history", "known_delay", "ramp"))


class _OneCamera(RandomizedEnv):
    """A randomised task whose object is seen with the goal's errors: a tracked cube is the goal."""

    def _drawn(self, uniforms: jax.Array, normals: jax.Array) -> Drawn:
        drawn = super()._drawn(uniforms, normals)
        return drawn.replace(offset=_as_the_goal(drawn.offset))

    def _draw_noise(self, physics: RandomizedPhysics) -> RandomizedPhysics:
        drawn = super()._draw_noise(physics)
        return drawn.replace(noise=_as_the_goal(drawn.noise))


def _as_the_goal(errors: jax.Array) -> jax.Array:
    """Returns the errors of `SOURCES`, `[3, 3]`, with the goal's for the object."""
    return errors.at[SOURCES.index("object")].set(errors[SOURCES.index("goal")])


class ParallelFetch:
    """A Fetch task with randomised episodes, and policies for it that take turns.

    Args:
      task: a Fetch task's name.
      policies: with the same network sizes, past and task options.
      episodes: of a point; all points have the same starts.
      seed: of the episodes.
    """

    def __init__(self, task: str, policies: Sequence[MeanPolicy], episodes: int, seed: int) -> None:
        shown = policies[0].randomization
        most = dataclasses.replace(_MOST, history=shown.history, known_delay=shown.known_delay)
        fetch = hgail_envs.make(task, impl="c", **policies[0].task_options)
        randomized = _OneCamera if tracks_cube(policies[0]) else RandomizedEnv
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

        def run(posture: float, sizes: Mapping[str, Any], rng: jax.Array) -> EpisodeMetrics:
            env = randomized(fetch, dataclasses.replace(most, posture=posture))
            return rollout(env.with_sizes(sizes), act, rng, episodes, lift_test=True).outcome

        self._run: Callable[..., EpisodeMetrics] = jax.jit(run, static_argnums=0)
        self._rng = jax.random.key(seed)

    def outcomes(self, **sizes: Any) -> EpisodeMetrics:
        """Returns the outcomes of a point's episodes, leaves `[episodes]`.

        Args:
          **sizes: fields of `Randomization` but `history`, `known_delay` and `ramp`; the others are nominal. Each
            `posture` compiles a program of its own.
        """
        unknown = set(sizes) - set(_SIZES)
        if unknown:
            raise ValueError(f"a point cannot have {min(unknown)!r}; it may have {', '.join(_SIZES)}")
        point = vars(Randomization(**sizes))
        traced = {name: point[name] for name in _SIZES if name != "posture"}
        return jax.tree.map(np.asarray, self._run(point["posture"], traced, self._rng))

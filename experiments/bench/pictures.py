"""Rows of pictures: how many a renderer makes in a second, alone and with the physics between them."""

import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

from experiments.bench.workload import Workload, compile_timed, seconds_side_by_side
from hgail_envs import State
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.pictures import KINDS, Pictures

_STEPS = 8  # pictures of each camera and environment in a call


def measure_pictures(workload: Workload, sizes: tuple[int, ...], look: str) -> Iterator[dict[str, Any]]:
    """Times two cameras of every environment, for each kind and size of pictures; yields rows."""
    for kind in KINDS:
        for size in sizes:
            pictures = Pictures(workload.env, size=size, look=look, kind=kind)
            yield {
                "task": workload.task,
                "impl": workload.env.impl,
                "renderer": pictures.renderer,
                "num_envs": workload.num_envs,
                "substeps": workload.substeps,
                "look": look,
                "kind": kind,
                "size": size,
                **_rates(workload, pictures),
            }


def _rates(workload: Workload, pictures: Pictures) -> dict[str, float]:
    env = CameraEnv(workload.env, pictures)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), workload.num_envs))
    actions = workload.actions()[:_STEPS]
    calls = {}
    for name, function in {"pictures": _see, "pictures_with_physics": _step}.items():
        program, _ = compile_timed(functools.partial(function, env), states, actions)
        calls[name] = functools.partial(program, states, actions)
    made = len(actions) * workload.num_envs * len(pictures.cameras)
    return {f"{name}_per_second": made / seconds for name, seconds in seconds_side_by_side(calls).items()}


def _see(env: CameraEnv, states: State, actions: jax.Array) -> jax.Array:
    """Returns the sum of pictures of `N` environments, other ones for each of the actions `[T, N, A]`."""

    def see(total: jax.Array, number: jax.Array) -> tuple[jax.Array, None]:
        return total + jnp.sum(env.see(states.obs + 1e-4 * number), dtype=jnp.uint32), None

    return jax.lax.scan(see, jnp.uint32(0), jnp.arange(len(actions), dtype=states.obs.dtype))[0]


def _step(env: CameraEnv, states: State, actions: jax.Array) -> jax.Array:
    """Returns the sum of the pictures after each of the actions `[T, N, A]`."""

    def step(carry: tuple[State, jax.Array], action: jax.Array) -> tuple[tuple[State, jax.Array], None]:
        states = jax.vmap(env.step)(carry[0], action)
        return (states, carry[1] + jnp.sum(env.see(states.obs), dtype=jnp.uint32)), None

    return jax.lax.scan(step, (states, jnp.uint32(0)), actions)[0][1]

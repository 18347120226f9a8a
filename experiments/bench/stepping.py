"""Measures stepping: the task's step in a compiled program, and beside it the engine alone on the same work."""

import functools
from collections.abc import Callable

import jax

import envs
from envs.engines import Control
from envs.fetch.arm import FetchEnv
from experiments.bench.bare_loops import measure_bare_loops
from experiments.bench.timing import compile_timed, seconds_per_call
from experiments.bench.workload import Workload


def measure_stepping(workload: Workload) -> dict[str, float]:
    """Times an episode of random actions: the task's step under a scan, then the engine's own loops.

    `raw_to_bare` compares with the fastest of these.
    """
    states, actions = workload.reset(), workload.actions()
    step, raw = time_steps(workload, states, actions)
    _, controls = step(states, actions)
    bare = measure_bare_loops(workload.env, states.pipeline_state, controls)
    fastest = max(value for name, value in bare.items() if name.startswith("bare"))
    return {**raw, **bare, "raw_to_bare": raw["raw_env_steps_per_second"] / fastest}


def time_steps(workload: Workload, states: envs.State, actions: jax.Array) -> tuple[Callable, dict[str, float]]:
    """Compiles and times `step_task`; returns the program, its speed and the seconds that its compilation took."""
    step, compile_seconds = compile_timed(functools.partial(step_task, workload.env), states, actions)
    raw = workload.env_steps / seconds_per_call(lambda: step(states, actions))
    return step, {"raw_env_steps_per_second": raw, "raw_compile_seconds": compile_seconds}


def step_task(env: FetchEnv, states: envs.State, actions: jax.Array) -> tuple[envs.State, Control]:
    """Steps `N` environments by actions `[T, N, action_size]`.

    Returns:
      The last states, `[N, ...]`, and what each action set the engine's controls to, `[T, N, ...]`.

    """

    def control(state: envs.State, action: jax.Array) -> Control:
        grip = action[3] if env.model.nu else None  # the fingers have servos
        return env.control(state.pipeline_state, action[:3], grip)

    def step(states: envs.State, actions: jax.Array) -> tuple[envs.State, Control]:
        return jax.vmap(env.step)(states, actions), jax.vmap(control)(states, actions)

    return jax.lax.scan(step, states, actions)

"""Stepping: the task's step in a compiled program, beside the bare engine on the same work."""

import functools
from collections.abc import Callable, Mapping

import jax

import hgail_envs
from experiments.bench.bare_loops import bare_loops
from experiments.bench.bare_warp import WarpLoop
from experiments.bench.timing import compile_timed, seconds_per_call
from experiments.bench.workload import Workload
from hgail_envs.engines import Control
from hgail_envs.fetch.arm import FetchEnv


class Stepping:
    """Calls to be timed, an episode of random actions each: the task's step under a scan, and the engine's bare loops.

    Args:
      workload: to step.

    """

    def __init__(self, workload: Workload) -> None:
        self._env_steps = workload.env_steps
        start = workload.reset()
        raw, self._compile_seconds = _raw(workload, start)
        _, controls = raw()
        self.calls = {"raw": raw, **bare_loops(workload.env, start.pipeline_state, controls)}
        """Calls by name: `raw`, and the engine's loops, whose names begin with `bare`."""

    def row(self, seconds: Mapping[str, float]) -> dict[str, float]:
        """Returns the row's columns from the seconds of each call: environment steps per second, kernels and ratios.

        `raw_to_bare` compares with the fastest of the loops.
        """
        rates = {name: self._env_steps / seconds[name] for name in self.calls}
        row = {f"{name}_env_steps_per_second": rate for name, rate in rates.items()}
        row["raw_compile_seconds"] = self._compile_seconds
        row["raw_to_bare"] = rates["raw"] / max(rate for name, rate in rates.items() if name.startswith("bare"))
        warp = self.calls.get("bare_warp")
        if isinstance(warp, WarpLoop):
            row |= {"kernels_per_substep": warp.kernels, "launch_floor_env_steps_per_second": warp.launch_floor()}
        return row


def raw_rate(workload: Workload) -> float:
    """Times `raw` alone; returns environment steps per second."""
    raw, _ = _raw(workload, workload.reset())
    return workload.env_steps / seconds_per_call(raw)


def _raw(workload: Workload, start: hgail_envs.State) -> tuple[Callable, float]:
    """Returns an episode of random actions as one compiled program, and the seconds of its compilation."""
    actions = workload.actions()
    step, compile_seconds = compile_timed(functools.partial(step_task, workload.env), start, actions)
    return functools.partial(step, start, actions), compile_seconds


def step_task(env: FetchEnv, states: hgail_envs.State, actions: jax.Array) -> tuple[hgail_envs.State, Control]:
    """Steps `N` environments by actions `[T, N, action_size]`.

    Returns:
      The last states, `[N, ...]`, and the engine's controls of each action, `[T, N, ...]`.

    """

    def control(state: hgail_envs.State, action: jax.Array) -> Control:
        grip = action[3] if env.model.nu else None  # the fingers have servos
        return env.control(state.pipeline_state, action[:3], grip)

    def step(states: hgail_envs.State, actions: jax.Array) -> tuple[hgail_envs.State, Control]:
        return jax.vmap(env.step)(states, actions), jax.vmap(control)(states, actions)

    return jax.lax.scan(step, states, actions)

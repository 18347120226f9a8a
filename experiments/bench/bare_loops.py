"""Bare engine loops on the start states and controls of a task's own steps: a lower bound of their cost.

Below, `N` is the number of environments and `T` of actions.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx, rollout

from experiments.bench.bare_warp import WarpLoop
from experiments.bench.timing import compile_timed
from hgail_envs.engines import Control, EngineState
from hgail_envs.engines.c import CEngine, usable_cores
from hgail_envs.engines.mjx import MjxEngine
from hgail_envs.fetch.arm import FetchEnv

_FULL_STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_CONTROL = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT)


def bare_loops(env: FetchEnv, physics: EngineState, controls: Control) -> dict[str, Callable[[], Any]]:
    """Returns the engine's bare loops by name, functions that step an episode each.

    Args:
      env: the task.
      physics: at the start, `[N, ...]`.
      controls: of the scene, `[T, N, ...]`.

    """
    engine = env.engine
    if isinstance(engine, CEngine):
        return {"bare_rollout": rollout_loop(engine, physics, controls)}
    assert isinstance(engine, MjxEngine)
    loops: dict[str, Callable[[], Any]] = {"bare_mjx": mjx_loop(engine, physics, controls)}
    if engine.name == "warp":
        loops["bare_warp"] = WarpLoop(engine.model, engine.substeps, physics, controls)
    return loops


def mjx_loop(engine: MjxEngine, physics: EngineState, controls: Control) -> Callable[[], jax.Array]:
    """Returns a function that steps MJX in one compiled program, and returns the last positions, `[N, nq]`.

    See `bare_loops` for the arguments.
    """
    model = jax.tree.map(jnp.asarray, engine.mjx_model)  # MJX-JAX treats NumPy's arrays as static

    def step(data: mjx.Data, control: Control) -> tuple[mjx.Data, None]:
        data = data.replace(mocap_pos=control.mocap_pos, mocap_quat=control.mocap_quat, ctrl=control.ctrl)
        return jax.lax.fori_loop(0, engine.substeps, lambda _, data: mjx.step(model, data), data), None

    def run(physics: EngineState, controls: Control) -> jax.Array:
        first = jax.tree.map(lambda values: values[0], controls)
        return jax.lax.scan(step, engine.data(physics, first), controls)[0].qpos

    compiled, _ = compile_timed(jax.vmap(run, in_axes=(0, 1)), physics, controls)
    return functools.partial(compiled, physics, controls)


def rollout_loop(engine: CEngine, physics: EngineState, controls: Control) -> Callable[[], np.ndarray]:
    """Returns a function that steps C MuJoCo, one call an action, and returns the last positions, `[N, nq]`.

    See `bare_loops` for the arguments.
    """
    pool = rollout.Rollout(nthread=usable_cores())
    model = engine.model
    datas = [mujoco.MjData(model) for _ in range(usable_cores())]
    count, nq, nv = len(physics.qpos), model.nq, model.nv
    start = np.zeros((count, mujoco.mj_stateSize(model, _FULL_STATE)))
    start[:, 1 : 1 + nq] = physics.qpos  # time comes first
    start[:, 1 + nq : 1 + nq + nv] = physics.qvel
    parts = (controls.ctrl, controls.mocap_pos, controls.mocap_quat)
    flat = [np.asarray(part, np.float64).reshape(*part.shape[:2], 1, math.prod(part.shape[2:])) for part in parts]
    packed = np.concatenate(flat, axis=-1)  # [T, N, 1, nu + 7 nmocap]: one control for all physics steps of an action

    def run() -> np.ndarray:
        state = start
        for control in packed:
            states, _ = pool.rollout(model, datas, state, control, control_spec=_CONTROL, nstep=engine.substeps)
            state = states[:, -1]
        return state[:, 1 : 1 + nq]

    return run

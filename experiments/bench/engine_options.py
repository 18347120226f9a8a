"""Speed and accuracy of MuJoCo Warp under other settings than the scene's."""

import copy
import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import mujoco
import numpy as np

from experiments.bench.bare_loops import rollout_loop
from experiments.bench.bare_warp import WarpLoop
from experiments.bench.stepping import step_task
from experiments.bench.timing import seconds_per_call
from experiments.bench.workload import Workload
from hgail_envs.engines import Control, EngineState
from hgail_envs.engines.c import CEngine

_COMPARED = 64  # environments that C MuJoCo steps too
_SWEEP_AND_PRUNE = 1  # mujoco_warp.BroadphaseType.SAP_TILE


@dataclasses.dataclass(frozen=True)
class EngineOptions:
    """Engine settings in place of a scene's own."""

    name: str
    scene: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Fields of `mujoco.MjOption`."""
    disabled: mujoco.mjtDisableBit | None = None
    """Part of the physics that is disabled, besides the scene's own."""
    warp: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Fields of MuJoCo Warp's `opt`."""

    def apply(self, model: mujoco.MjModel) -> mujoco.MjModel:
        """Returns a copy of a scene with these settings, except those of `warp`."""
        changed = copy.copy(model)
        for name, value in self.scene.items():
            setattr(changed.opt, name, value)
        changed.opt.disableflags |= 0 if self.disabled is None else int(self.disabled)
        return changed


_ALL_ITERATIONS = {"graph_conditional": False}
_CONVERGED = EngineOptions("converged", {"iterations": 100, "ls_iterations": 50, "tolerance": 1e-12})

ENGINE_OPTIONS = (
    EngineOptions("as it is"),
    EngineOptions("all iterations of the solver, converged or not", warp=_ALL_ITERATIONS),
    EngineOptions("at most 3 iterations of the solver", {"iterations": 3}),
    EngineOptions("at most 2", {"iterations": 2}),
    EngineOptions("3, converged or not", {"iterations": 3}, warp=_ALL_ITERATIONS),
    EngineOptions("2, converged or not", {"iterations": 2}, warp=_ALL_ITERATIONS),
    EngineOptions("1 iteration of the line search", {"ls_iterations": 1}),
    EngineOptions("no friction loss of joints", disabled=mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS),
    EngineOptions("integrator implicitfast", {"integrator": mujoco.mjtIntegrator.mjINT_IMPLICITFAST}),
    EngineOptions("broad phase by sweep and prune", warp={"broadphase": _SWEEP_AND_PRUNE}),
    EngineOptions("sparse Jacobian", {"jacobian": mujoco.mjtJacobian.mjJAC_SPARSE}),
    EngineOptions("conjugate gradients", {"solver": mujoco.mjtSolver.mjSOL_CG}),
    EngineOptions("elliptic cone", {"cone": mujoco.mjtCone.mjCONE_ELLIPTIC}),
)
"""Settings to measure; the others are compared with the first."""


def measure_options(workload: Workload) -> Iterator[dict[str, Any]]:
    """Yields a row for each of `ENGINE_OPTIONS`: kernels, speed, and the gripper's error after random actions.

    The error, in metres, is the distance from its position in C MuJoCo on the unchanged scene with a converged solver.

    Raises:
      ImportError: warp-lang is not installed.

    """
    states = workload.reset()
    step = jax.jit(step_task, static_argnums=0)
    _, controls = step(workload.env, states, workload.actions())
    start, engine = states.pipeline_state, workload.env.engine
    exact = _converged(engine.model, engine.period, workload.substeps, start, controls)
    for options in ENGINE_OPTIONS:
        loop = WarpLoop(options.apply(engine.model), workload.substeps, start, controls, options.warp)
        rate = workload.env_steps / seconds_per_call(loop)
        off = np.linalg.norm(gripper_positions(engine.model, loop.positions()[: len(exact)]) - exact, axis=-1)
        yield {
            "task": workload.task,
            "impl": "warp",
            "num_envs": workload.num_envs,
            "substeps": workload.substeps,
            "what": options.name,
            "kernels_per_substep": loop.kernels,
            "bare_warp_env_steps_per_second": rate,
            "gripper_off_median": float(np.median(off)),
            "gripper_off_worst": float(off.max()),
        }


def gripper_positions(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Returns the gripper's positions, `[N, 3]` in metres, for joint positions `[N, nq]`."""
    data, positions = mujoco.MjData(model), []
    for data.qpos[:] in qpos:
        mujoco.mj_kinematics(model, data)
        positions.append(data.body("gripper").xpos.copy())
    return np.array(positions)


def _converged(
    model: mujoco.MjModel, period: float, substeps: int, start: EngineState, controls: Control
) -> np.ndarray:
    """Returns the final gripper positions of the first `_COMPARED` environments, with a converged solver."""
    engine = CEngine(_CONVERGED.apply(model), period, substeps, worlds=_COMPARED)
    some_controls = jax.tree.map(lambda values: np.asarray(values)[:, :_COMPARED], controls)
    some_starts = jax.tree.map(lambda values: np.asarray(values)[:_COMPARED], start)
    return gripper_positions(model, rollout_loop(engine, some_starts, some_controls)())

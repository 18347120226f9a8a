"""The engine's own loops do the work that the task's steps do."""

import jax
import numpy as np
import pytest

from experiments.bench.bare_loops import mjx_loop, rollout_loop
from experiments.bench.bare_warp import WarpLoop
from experiments.bench.stepping import Stepping, step_task
from experiments.bench.workload import Workload

ARM = slice(3, 11)  # joints that move; the base stands, and reach puts its fingers back after each action


def run_both(task, impl, substeps):
    """Start, end by the task's steps, and end by the engine's own loop: positions `[N, nq]`."""
    workload = Workload(task, impl, num_envs=3, substeps=substeps, quick=True)
    states, engine = workload.reset(), workload.env.engine
    ends, controls = jax.jit(step_task, static_argnums=0)(workload.env, states, workload.actions())
    start = states.pipeline_state
    bare = rollout_loop(engine, start, controls)() if impl == "c" else mjx_loop(engine, start, controls)()
    return np.asarray(start.qpos), np.asarray(ends.pipeline_state.qpos), np.asarray(bare)


def test_the_loop_of_c_mujoco_ends_where_the_task_does():
    start, end, bare = run_both("grasp", "c", substeps=8)
    assert np.ptp(end - start, axis=0).max() > 0.01, "the environments are to do different things"
    np.testing.assert_allclose(bare, end, atol=1e-6)  # radians and metres; the task rounds to single precision


def test_the_loop_of_c_mujoco_moves_the_arm_as_reach_does():
    start, end, bare = run_both("reach", "c", substeps=4)
    assert np.abs(end - start)[:, ARM].max() > 0.1
    np.testing.assert_allclose(bare[:, ARM], end[:, ARM], atol=1e-3)


@pytest.mark.slow
def test_the_loop_of_mjx_ends_where_the_task_does():
    start, end, bare = run_both("grasp", "jax", substeps=8)
    assert np.ptp(end - start, axis=0).max() > 0.01
    np.testing.assert_allclose(bare, end, atol=1e-4)


@pytest.mark.slow
def test_the_loop_of_mujoco_warp_moves_the_arm_as_reach_does():
    pytest.importorskip("warp")
    workload = Workload("reach", "c", num_envs=3, substeps=4, quick=True)
    states = workload.reset()
    ends, controls = jax.jit(step_task, static_argnums=0)(workload.env, states, workload.actions())
    loop = WarpLoop(workload.env.engine.model, 4, states.pipeline_state, controls)
    for _ in range(2):  # each call starts anew
        loop()
        np.testing.assert_allclose(loop.positions()[:, ARM], ends.pipeline_state.qpos[:, ARM], atol=1e-2)


def test_a_row_of_stepping_has_the_rates_that_its_seconds_say():
    workload = Workload("reach", "c", num_envs=2, substeps=4, quick=True)
    stepping = Stepping(workload)
    for call in stepping.calls.values():
        call()
    row = stepping.row({"raw": 0.5, "bare_rollout": 0.25})
    assert row["raw_env_steps_per_second"] == workload.env_steps / 0.5
    assert row["bare_rollout_env_steps_per_second"] == workload.env_steps / 0.25
    assert row["raw_to_bare"] == 0.5

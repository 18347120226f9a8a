"""Settings of the engine are what they are called, and what they change is measured on the same episode."""

import sys
from types import SimpleNamespace

import jax
import mujoco
import numpy as np
import pytest

from experiments.bench.bare_warp import _count_launches
from experiments.bench.engine_options import ENGINE_OPTIONS, EngineOptions, gripper_positions, measure_options
from experiments.bench.stepping import step_task
from experiments.bench.workload import Workload


@pytest.fixture
def workload():
    return Workload("grasp", "c", num_envs=3, substeps=8, quick=True)


def test_settings_are_those_of_a_copy(workload):
    scene = workload.env.engine.model
    left_out, iterations = scene.opt.disableflags, scene.opt.iterations
    assert left_out, "the scene leaves something out, which has to stay so"
    sensors = mujoco.mjtDisableBit.mjDSBL_SENSOR
    changed = EngineOptions("some", {"iterations": iterations + 3}, sensors).apply(scene)
    assert (changed.opt.iterations, changed.opt.disableflags) == (iterations + 3, left_out | sensors)
    assert (scene.opt.iterations, scene.opt.disableflags) == (iterations, left_out)
    assert changed.opt.timestep == scene.opt.timestep


def test_the_first_settings_are_the_scenes(workload):
    scene = workload.env.engine.model
    first, *others = ENGINE_OPTIONS
    assert str(first.apply(scene).opt) == str(scene.opt) and not first.warp
    assert all(str(other.apply(scene).opt) != str(scene.opt) or other.warp for other in others)


def test_the_gripper_is_where_the_base_takes_it(workload):
    scene = workload.env.engine.model
    qpos = np.stack([scene.qpos0] * 2)
    qpos[1, scene.joint("base_x").qposadr] += 0.1
    before, after = gripper_positions(scene, qpos)
    np.testing.assert_allclose(after - before, [0.1, 0, 0], atol=1e-12)


def test_a_launch_of_nothing_is_no_kernel(monkeypatch):
    done = []

    def launch(kernel, dim, **options):
        del dim, options
        done.append(kernel)

    warp = SimpleNamespace(launch=launch, launch_tiled=launch)
    monkeypatch.setitem(sys.modules, "warp", warp)

    def step():
        warp.launch("bodies", 3)
        warp.launch("tendons", dim=0, inputs=[])
        warp.launch_tiled("rows", dim=(2, 4))
        warp.launch_tiled("flexes", dim=(2, 0))

    assert _count_launches(step) == 2
    assert done == ["bodies", "tendons", "rows", "flexes"]
    assert warp.launch is warp.launch_tiled is launch


@pytest.mark.slow
def test_rows_are_of_the_episode_that_the_task_steps(workload):
    """On MuJoCo Warp, which may run on a CPU too; its solver is stopped early, C MuJoCo's is not."""
    pytest.importorskip("warp")
    rows = {row["what"]: row for row in measure_options(workload)}
    ends, _ = jax.jit(step_task, static_argnums=0)(workload.env, workload.reset(), workload.actions())
    model = workload.env.engine.model
    start, end = (
        gripper_positions(model, np.asarray(states.pipeline_state.qpos)) for states in (workload.reset(), ends)
    )
    assert np.linalg.norm(end - start, axis=1).min() > 0.01, "else any settings end near by"
    assert len(rows) == len(ENGINE_OPTIONS)
    assert rows["as it is"]["gripper_off_worst"] < 5e-4
    kernels = [
        rows[name]["kernels_per_substep"] for name in ("as it is", "at most 3 iterations of the solver", "at most 2")
    ]
    assert kernels[0] - kernels[1] == kernels[1] - kernels[2] > 5  # as many for each iteration
    assert rows["broad phase by sweep and prune"]["kernels_per_substep"] > kernels[0]

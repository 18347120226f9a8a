"""What holds for every engine that runs here: which one is chosen, and that all step the same scene alike."""

import importlib.util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hgail_envs.engines import Control, EngineState, make_engine, resolve_impl

PERIOD = 0.04
TOLERANCES = {"c": (1e-6, 1e-6, 1e-6), "jax": (3e-4, 1e-2, 1e-4)}
"""By engine that runs here: of positions, velocities and sensors. MJX leaves out how a weld's Jacobian changes."""

ENGINES = ["c", pytest.param("jax", marks=pytest.mark.slow)]

# A motor turns a pendulum, whose tip a weld pulls to a mocap body; and a sensor. Small enough to compile in a second.
MODEL = mujoco.MjModel.from_xml_string(
    """<mujoco><option timestep=".002"/><worldbody><body name="hand" mocap="true" pos="0 0 .5"/>
      <body name="arm" pos="0 0 1"><joint name="hinge" axis="0 1 0" damping=".1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02"/>
        <body name="tip" pos="0 0 -.5"><joint name="slide" type="slide" axis="0 0 1" damping="1"/>
          <geom type="sphere" size=".05"/></body></body></worldbody>
      <equality><weld body1="hand" body2="tip" solref=".05 1"/></equality>
      <actuator><motor joint="hinge" gear="2"/></actuator><sensor><jointpos joint="slide"/></sensor></mujoco>"""
)


def random_actions(count):
    """Returns states, `qpos` and `qvel`, and controls that pull the tip by up to 5 cm, as the tasks do."""
    rng = np.random.default_rng(0)
    pull = np.array([0.0, 0.0, 0.5]) + rng.uniform(-0.05, 0.05, (count, 1, 3))
    turn = np.array([1.0, 0.0, 0.0, 0.0]) + 0.05 * rng.normal(size=(count, 1, 4))
    ctrl = np.linspace(-1.0, 1.0, count)[:, None]
    return rng.normal(size=(count, 2)) * 0.03, rng.normal(size=(count, 2)) * 0.1, pull, turn, ctrl


def by_hand(substeps, qpos, qvel, mocap_pos, mocap_quat, ctrl):
    MODEL.opt.timestep = PERIOD / substeps
    data = mujoco.MjData(MODEL)
    data.qpos, data.qvel, data.mocap_pos, data.mocap_quat, data.ctrl = qpos, qvel, mocap_pos, mocap_quat, ctrl
    for _ in range(substeps):
        mujoco.mj_step(MODEL, data)
    MODEL.opt.timestep = 0.002
    return data.qpos.copy(), data.qvel.copy(), data.sensordata.copy()


@pytest.mark.parametrize("impl", ENGINES)
def test_a_batch_of_actions_is_mujoco_s_own_and_so_with_more_steps(impl):
    count = 8
    qpos, qvel, mocap_pos, mocap_quat, ctrl = random_actions(count)
    state = EngineState(
        qpos=jnp.asarray(qpos, jnp.float32),
        qvel=jnp.asarray(qvel, jnp.float32),
        warmstart=jnp.zeros((count, MODEL.nv)),
        sensordata=jnp.zeros((count, MODEL.nsensordata)),
        overflow=jnp.zeros(count, bool),
    )
    control = Control(*(jnp.asarray(array, jnp.float32) for array in (mocap_pos, mocap_quat, ctrl)))
    few = make_engine(impl, MODEL, PERIOD, 5, worlds=1)
    many = few.with_substeps(20)
    ends = {}
    for engine, substeps in ((few, 5), (many, 20)):
        assert (engine.name, engine.substeps, engine.model.opt.timestep) == (impl, substeps, PERIOD / substeps)
        after = jax.jit(jax.vmap(engine.step))(state, control)
        ends[substeps] = found = [np.asarray(array) for array in (after.qpos, after.qvel, after.sensordata)]
        rows = zip(*(by_hand(substeps, *row) for row in zip(*random_actions(count), strict=True)), strict=True)
        for ours, theirs, tolerance in zip(found, rows, TOLERANCES[impl], strict=True):
            np.testing.assert_allclose(ours, np.array(theirs), atol=tolerance, rtol=0)
    assert np.abs(ends[5][0] - ends[20][0]).max() > 2e-3  # so that the two differ


@pytest.mark.parametrize("impl", ENGINES)
def test_each_environment_has_its_own_model(impl):
    """Damping, gear and masses of each against a model in which they are set by hand."""
    count, substeps = 4, 5
    rows = random_actions(count)
    qpos, qvel, mocap_pos, mocap_quat, ctrl = (jnp.asarray(array, jnp.float32) for array in rows)
    factors = np.linspace(0.3, 3.0, count)
    fields = {
        name: np.stack([getattr(MODEL, name) * factor for factor in factors])
        for name in ("dof_damping", "actuator_gear", "body_mass", "body_inertia")
    }
    state = EngineState(qpos, qvel, jnp.zeros((count, 2)), jnp.zeros((count, 1)), jnp.zeros(count, bool))
    control = Control(mocap_pos, mocap_quat, ctrl, {name: jnp.asarray(values) for name, values in fields.items()})
    after = jax.jit(jax.vmap(make_engine(impl, MODEL, PERIOD, substeps, worlds=1).step))(state, control)
    plain = jax.jit(jax.vmap(make_engine(impl, MODEL, PERIOD, substeps, worlds=1).step))(
        state, control.replace(model=None)
    )
    before = {name: getattr(MODEL, name).copy() for name in fields}
    for index, row in enumerate(zip(*rows, strict=True)):
        for name, values in fields.items():
            getattr(MODEL, name)[...] = values[index]
        expected = by_hand(substeps, *row)
        for name, values in before.items():
            getattr(MODEL, name)[...] = values
        ours = (after.qpos[index], after.qvel[index], after.sensordata[index])
        for one, other, tolerance in zip(ours, expected, TOLERANCES[impl], strict=True):
            np.testing.assert_allclose(one, other, atol=tolerance, rtol=0.02)
    assert np.abs(np.asarray(after.qpos - plain.qpos)).max() > 8e-4


@pytest.mark.parametrize("impl", TOLERANCES)
def test_nothing_of_the_model_that_it_is_made_of_is_changed(impl):
    make_engine(impl, MODEL, PERIOD, 5, worlds=1).with_substeps(20)
    assert MODEL.opt.timestep == 0.002


@pytest.mark.parametrize(
    ("backend", "has_warp", "chosen"),
    [("cpu", False, "c"), ("cpu", True, "c"), ("gpu", True, "warp"), ("gpu", False, "jax"), ("tpu", True, "jax")],
)
def test_auto_is_the_fastest_that_is_there(monkeypatch, backend, has_warp, chosen):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if has_warp and name == "warp" else None)
    assert resolve_impl("auto") == chosen
    assert resolve_impl("jax") == "jax"
    if backend == "cpu":
        assert resolve_impl("c") == "c"
    else:
        with pytest.raises(ValueError, match="impl 'c' is for programs on a CPU; use 'auto', or set JAX_PLATFORMS=cpu"):
            resolve_impl("c")
    if chosen == "warp":
        assert resolve_impl("warp") == "warp"
    else:
        with pytest.raises(ValueError, match="impl 'warp' needs warp-lang and an NVIDIA GPU; use 'jax', 'c' or 'auto'"):
            resolve_impl("warp")


@pytest.mark.parametrize("device", ["cpu", jax.devices("cpu")[0]])
def test_beside_a_gpu_programs_that_run_on_the_cpu_have_c_mujoco(monkeypatch, device):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with jax.default_device(device):
        assert resolve_impl("c") == resolve_impl("auto") == "c"


def test_an_unknown_engine_is_refused():
    with pytest.raises(ValueError, match="unknown impl 'bullet'; choose from auto, warp, c, jax"):
        resolve_impl("bullet")

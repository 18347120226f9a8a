"""Furniture of Franka Kitchen, unchanged, in the scenes of the page on own tasks."""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import hgail_envs
from tests.support import own_tasks

package = pytest.importorskip("gymnasium_robotics")
ASSETS = Path(package.__path__[0]) / "envs" / "assets" / "kitchen_franka"
HAND = ("palm", "right_pad", "left_pad")


@pytest.fixture(scope="module")
def kitchen():
    """Returns the Kitchen as Gymnasium-Robotics has it."""
    return mujoco.MjModel.from_xml_path(str(ASSETS / "kitchen_assets" / "kitchen_env_model.xml"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    with own_tasks(tmp_path_factory.mktemp("own")) as folder:
        (folder / "kitchen_franka").symlink_to(ASSETS)
        yield folder


@pytest.fixture(scope="module", params=["Cabinet", "Microwave"])
def env(request, folder):
    return hgail_envs.make(f"kitchen:{request.param}", substeps=8, robot="franka")


def colliding(model, body):
    """Returns the numbers of a body's geoms that the Kitchen lets collide, in its order."""
    of_body = np.flatnonzero(model.geom_bodyid == model.body(body).id)
    return [geom for geom in of_body if model.geom_group[geom] == 4]


def body_of(model, env):
    return model.body(model.jnt_bodyid[model.joint(env.object_name).id])


def test_the_part_moves_as_in_the_kitchen(env, kitchen):
    own, other = body_of(env.model, env), body_of(kitchen, env)
    for field in ("mass", "inertia", "ipos"):
        np.testing.assert_allclose(getattr(own, field), getattr(other, field))
    for field in ("range", "damping", "frictionloss", "armature", "axis"):
        there = getattr(kitchen.joint(env.object_name), field)
        np.testing.assert_allclose(getattr(env.model.joint(env.object_name), field), there)


def test_the_hand_touches_all_that_collides_in_the_kitchen_and_nothing_else_does(env, kitchen):
    model = env.model
    part = body_of(kitchen, env).name
    bodies = [kitchen.body(kitchen.body(part).parentid[0]).name, part]
    expected = [(body, place) for body in bodies for place in range(len(colliding(kitchen, body)))]
    found = []
    for number, (one, other) in enumerate(zip(model.pair_geom1, model.pair_geom2, strict=True)):
        body = model.body(model.geom_bodyid[one]).name
        place = colliding(model, body).index(one)
        found.append((body, place, model.geom(other).name))
        as_there = colliding(kitchen, body)[place]
        assert model.geom_type[one] == kitchen.geom_type[as_there]
        assert model.pair_dim[number] == kitchen.geom_condim[as_there]
        slide, spin, roll = kitchen.geom_friction[as_there]
        np.testing.assert_allclose(model.pair_friction[number], [slide, slide, spin, roll, roll])
        np.testing.assert_allclose(model.pair_solref[number], kitchen.geom_solref[as_there])
        np.testing.assert_allclose(model.pair_solimp[number], kitchen.geom_solimp[as_there])
    assert sorted(found) == sorted((*each, hand) for each in expected for hand in HAND)
    assert not model.geom_contype.any()


def test_a_door_does_not_touch_its_frame_in_the_arm_s_full_model(env):
    model = env.robot.full_model()
    data = mujoco.MjData(model)
    data.qpos[:] = env.robot.settle().qpos
    mujoco.mj_forward(model, data)
    assert data.ncon == 0


def led(env, way, steps, state):
    """Returns the state after steps towards `way(physics)`, `[3]`, less the gripper's position."""

    def advance(_, state):
        physics = state.pipeline_state
        apart = (way(physics) - physics.gripper_position) / 0.04
        return env.step(state, jnp.append(jnp.clip(apart, -1.0, 1.0), 0.0))

    return jax.jit(lambda state: jax.lax.fori_loop(0, steps, advance, state))(state)


def closed_hand(env, stages):
    """Returns the state after stages of a closed hand: places less the handle's start, metres, and steps."""
    state = jax.jit(env.reset)(jax.random.key(0))
    handle = env.object_position(state.pipeline_state)
    for away, steps in stages:
        state = led(env, lambda physics, away=away: handle + jnp.array(away), steps, state)
    return state


def test_a_hand_beside_the_handle_slides_the_cabinet_to_the_kitchen_s_goal(folder):
    env = hgail_envs.make("kitchen:Cabinet", substeps=8, robot="franka")
    around = [([-0.1, 0.0, 0.05], 6), ([-0.1, 0.14, 0.05], 6), ([0.0, 0.14, 0.05], 4), ([0.0, -0.3, 0.05], 20)]
    state = closed_hand(env, around)
    assert env.joint_position(state.pipeline_state) > 0.37
    assert state.info["achieved_goal"][3] == 1.0


def test_a_hand_beside_the_handle_opens_the_microwave_to_the_kitchen_s_goal(folder):
    env = hgail_envs.make("kitchen:Microwave", substeps=8, robot="franka")
    hinge = jnp.array([1.704 - 0.176, 0.88 + 0.345])  # metres, by the files

    def along_the_circle(physics):
        place = env.object_position(physics)
        x, y = (place[:2] - hinge) / jnp.linalg.norm(place[:2] - hinge)
        return place + jnp.array([0.03 * y + 0.015 * x, -0.03 * x + 0.015 * y, 0.1])

    state = closed_hand(env, [([-0.05, -0.1, 0.1], 8), ([0.0, -0.1, 0.1], 4), ([0.0, 0.0, 0.1], 4)])
    state = led(env, along_the_circle, 34, state)
    assert env.joint_position(state.pipeline_state) < -0.75
    assert state.info["achieved_goal"][3] == 1.0

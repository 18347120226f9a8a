"""Furniture of Franka Kitchen, unchanged, in the scenes of the page on own tasks."""

import functools
from pathlib import Path

import jax
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


@pytest.fixture(scope="module")
def made(folder):
    return functools.cache(lambda name: hgail_envs.make(f"kitchen:{name}", substeps=8, robot="franka"))


@pytest.fixture(scope="module", params=["Cabinet", "Microwave"])
def env(request, made):
    return made(request.param)


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


def led(env, stages):
    """Returns the state after stages of a closed hand, from the start of an episode.

    A stage leads it to `way(physics, handle)`, `[3]`, by the handle's start, `[3]`, metres, in so many steps.
    """
    state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
    handle = np.asarray(jax.jit(env.object_position)(state.pipeline_state))
    for way, steps in stages:
        for _ in range(steps):
            physics = jax.device_get(state.pipeline_state)
            apart = (way(physics, handle) - physics.gripper_position) / 0.04
            state = step(state, np.append(np.clip(apart, -1.0, 1.0), 0.0).astype(np.float32))
    return state


def beside(*away):
    """Returns the way to a place so far from the handle's start, metres."""
    return lambda physics, handle: handle + away


def test_a_hand_beside_the_handle_slides_the_cabinet_to_the_kitchen_s_goal(made):
    env = made("Cabinet")
    around = [(beside(-0.1, 0.0, 0.05), 6), (beside(-0.1, 0.14, 0.05), 6), (beside(0.0, 0.14, 0.05), 4)]
    state = led(env, [*around, (beside(0.0, -0.3, 0.05), 20)])
    assert env.joint_position(state.pipeline_state) > 0.37
    assert state.info["achieved_goal"][3] == 1.0


def test_a_hand_beside_the_handle_opens_the_microwave_to_the_kitchen_s_goal(made):
    env = made("Microwave")
    hinge = np.array([1.704 - 0.176, 0.88 + 0.345])  # metres, by the files
    place_of = jax.jit(env.object_position)

    def along_the_circle(physics, _):
        place = np.asarray(place_of(physics))
        x, y = (place[:2] - hinge) / np.linalg.norm(place[:2] - hinge)
        return place + np.array([0.03 * y + 0.015 * x, -0.03 * x + 0.015 * y, 0.1])

    there = [(beside(-0.05, -0.1, 0.1), 8), (beside(0.0, -0.1, 0.1), 4), (beside(0.0, 0.0, 0.1), 4)]
    state = led(env, [*there, (along_the_circle, 34)])
    assert env.joint_position(state.pipeline_state) < -0.75
    assert state.info["achieved_goal"][3] == 1.0

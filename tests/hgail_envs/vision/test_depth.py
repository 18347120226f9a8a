"""Pictures of depth: distances by a closed form and by MuJoCo's rays, and what they do not depend on."""

import copy
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import hgail_envs
from hgail_envs.vision.cameras import describe_cameras
from hgail_envs.vision.depth import FAR
from hgail_envs.vision.look import LOOKS, split_draws
from hgail_envs.vision.pictures import Pictures
from tests.hgail_envs.vision.test_pictures import pixel, poses, push

pytestmark = pytest.mark.usefixtures("rendering")
SIZE = 64
CUBE, TABLE_HEIGHT = 0.025, 0.4  # half of the cube's edge, metres


def grey(distance):
    return np.round(255.0 * np.minimum(np.asarray(distance) / FAR, 1.0))


@functools.cache
def made(look="plain", cameras=("front", "side", "wrist"), target="given"):
    return Pictures(push(), cameras, SIZE, look=look, target=target, kind="depth")


def shown(pictures, qpos, draws=None):
    """Returns pictures, integers `[N, cameras, size, size]`."""
    draws = jnp.zeros((len(qpos), pictures.draws)) if draws is None else draws
    seen = np.asarray(jax.jit(pictures)(qpos, draws))
    assert seen.shape == (len(qpos), *pictures.shape) and seen.dtype == np.uint8 and seen.shape[-1] == 1
    return seen[..., 0].astype(int)


@pytest.mark.parametrize("raised", [0.0, 1.0])
def test_a_camera_that_looks_straight_down_sees_the_heights_of_table_and_cube(raised):
    """The distance is from the camera's plane, so that a level table has one everywhere; the sky is white."""
    env, place, height, fovy = copy.copy(push()), np.array([1.18, 0.5, TABLE_HEIGHT + CUBE]), 1.0, 18.0
    env.robot = copy.copy(env.robot)

    def spec():
        scene = push().robot.spec()
        at = [*place[:2], height]
        scene.worldbody.add_camera(name="above", pos=at, xyaxes=[0, -1, 0, 1, 0, 0], fovy=fovy)
        scene.worldbody.add_camera(name="sky", pos=at, xyaxes=[0, 1, 0, 1, 0, 0], fovy=fovy)
        return scene

    env.robot.spec = spec
    qpos = np.array(poses()[:1])
    qpos[0, env.qpos_of("cube")] = place
    pictures = Pictures(env, ["above", "sky"], SIZE, look="cameras", kind="depth")
    draws = np.zeros((1, pictures.draws), np.float32)
    split_draws(pictures.model, draws)["shift"][0, pictures.model.camera("above").id, 2] = raised  # parts are views
    height += raised * LOOKS["cameras"].camera_shift
    ((above, sky),) = shown(pictures, jnp.asarray(qpos), jnp.asarray(draws))
    expected = np.full((SIZE, SIZE), grey(height - TABLE_HEIGHT))
    half = CUBE / (height - TABLE_HEIGHT - 2 * CUBE) * SIZE / 2 / np.tan(np.deg2rad(fovy) / 2)
    distance = np.abs(np.arange(SIZE) + 0.5 - SIZE / 2)
    middle = np.maximum.outer(distance, distance)
    expected[middle < half] = grey(height - TABLE_HEIGHT - 2 * CUBE)
    sure = np.abs(middle - half) > 1.0  # pixel; the cube's edge
    np.testing.assert_array_equal(above[sure], expected[sure])
    assert (sky == 255).all()


def test_distances_are_those_of_mujocos_rays():
    pictures, qpos, rng = made(), poses(), np.random.default_rng(0)
    seen, data = shown(pictures, qpos), mujoco.MjData(pictures.model)
    groups, hit, apart = np.array([1, 1, 1, 0, 0, 0], np.uint8), np.zeros(1, np.int32), []
    for scene in range(len(qpos)):
        data.qpos[:] = qpos[scene]
        mujoco.mj_kinematics(pictures.model, data)
        mujoco.mj_camlight(pictures.model, data)
        for camera, name in enumerate(pictures.cameras):
            focal = SIZE / 2 / np.tan(np.deg2rad(pictures.model.camera(name).fovy[0]) / 2)
            frame = data.camera(name).xmat.reshape(3, 3)
            for x, y in rng.integers(0, SIZE, (100, 2)):
                ray = np.array([x + 0.5 - SIZE / 2, SIZE / 2 - y - 0.5, -focal]) / focal  # one metre along the axis
                args = data.camera(name).xpos, frame @ ray, groups, 1, -1, hit
                distance = mujoco.mj_ray(pictures.model, data, *args)
                apart.append(seen[scene, camera, y, x] - grey(distance if distance >= 0.0 else FAR))
    apart = np.abs(apart)
    assert (apart <= 1).mean() > 0.98  # round shapes have few facets
    assert (apart == 0).mean() > 0.9


def test_the_marker_is_as_far_as_the_goal():
    pictures, goal = made(target="seen"), np.array([1.2, 0.65, 0.5])
    (seen,) = shown(pictures, jnp.concatenate([poses()[:1], goal[None]], axis=1))
    for camera, described in enumerate(describe_cameras(pictures.model, pictures.cameras, SIZE)[:2]):
        x, y = np.floor(pixel(described, goal)).astype(int)
        away = np.linalg.norm(goal - described["position"])
        axis = -np.array(described["rotation"])[:, 2]
        front = goal + 0.02 * (described["position"] - goal) / away  # of the ball
        assert seen[camera, y, x] == pytest.approx(grey(axis @ (front - described["position"])), abs=1)


@pytest.mark.parametrize("look", ["colours", "light", "shadows"])
def test_colours_light_and_shadows_are_not_seen(look):
    pictures, ones = made(look), jnp.ones((4, made(look).draws))
    np.testing.assert_array_equal(shown(pictures, poses(), ones), shown(made(), poses()))


def test_a_copy_is_of_the_same_kind():
    again = copy.copy(made(cameras=("side",)))
    assert (again.kind, again.shape) == ("depth", (1, SIZE, SIZE, 1))


@pytest.mark.parametrize("task", ["push", "slide"])
def test_the_tables_top_is_nearer_than_what_is_white(task):
    model = hgail_envs.make(task).robot.load(visual=True)
    table = model.geom("long_table" if task == "slide" else "table")
    corners = table.pos + table.size * np.array([[x, y, 1.0] for x in (-1, 1) for y in (-1, 1)])
    for name in ("front", "side"):
        (described,) = describe_cameras(model, [name], SIZE)
        axis = -np.array(described["rotation"])[:, 2]
        assert ((corners - described["position"]) @ axis < FAR).all()

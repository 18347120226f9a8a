"""Pictures of scenes: each shows its own scene, from where its camera is."""

import copy
import functools
import importlib.util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import hgail_envs
from hgail_envs.vision.cameras import camera_ids, describe_cameras
from hgail_envs.vision.look import Look, draws_of, split_draws
from hgail_envs.vision.opengl import OpenGLRenderer
from hgail_envs.vision.pictures import Pictures, resolve_renderer
from hgail_envs.vision.things import JOINTS
from hgail_envs.vision.warp_renderer import as_one_batch

pytestmark = pytest.mark.usefixtures("rendering")

SIZE = 64
PLACES = np.array([[1.2, 0.57, 0.425], [1.45, 0.93, 0.425], [1.25, 0.95, 0.425], [1.42, 0.6, 0.425]])


@functools.cache
def push():
    return hgail_envs.make("push")


@functools.cache
def made(look="plain", cameras=("front", "side"), target="given"):
    return Pictures(push(), cameras, SIZE, look=look, target=target)


def poses():
    """Joint positions with the arm at its start, and the cube at each of `PLACES`."""
    env = push()
    qpos = np.tile(np.asarray(env._start_qpos, np.float32), (len(PLACES), 1))
    qpos[:, env.qpos_of("cube")] = PLACES
    return jnp.asarray(qpos)


def pixel(described, point):
    """Returns where a point is in a camera's picture, x and y, by the description of a camera that stands still."""
    rotation, inside = np.array(described["rotation"]), described["intrinsics"]
    x, y, z = rotation.T @ (point - np.array(described["position"]))
    return np.array([inside["cx"] - inside["fx"] * x / z, inside["cy"] + inside["fy"] * y / z])


def orange(picture):
    """Returns the middle of what is orange in a picture, x and y in pixels, and how many pixels are."""
    red, green, blue = (picture[..., channel].astype(int) for channel in range(3))
    return middle((red > 120) & (green > 60) & (red - blue > 90) & (green - blue > 30))


def red(picture):
    """Returns the middle of what is red in a picture, and how many pixels are."""
    red, green, blue = (picture[..., channel].astype(int) for channel in range(3))
    return middle((red > 90) & (red > 3 * green) & (red > 3 * blue))


def middle(mask):
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5]), len(rows)


def test_a_cube_is_seen_where_a_pinhole_camera_has_it():
    pictures = made()
    seen = np.asarray(jax.jit(pictures)(poses(), jnp.zeros((len(PLACES), pictures.draws))))
    assert seen.shape == (len(PLACES), 2, SIZE, SIZE, 3) and seen.dtype == np.uint8
    for camera, described in enumerate(describe_cameras(pictures.model, pictures.cameras, SIZE)):
        for scene, place in enumerate(PLACES):
            middle, count = orange(seen[scene, camera])
            assert count >= 4
            np.testing.assert_allclose(middle, pixel(described, place), atol=2.0)


@pytest.mark.parametrize(
    ("turn", "zoom"), [([0.2, 0, 0], 0), ([0, 0.2, 0], 0), ([0, 0, 0.8], 0), ([0, 0, 0], 0.5), ([0, 0, 0], -0.3)]
)
def test_a_camera_turns_about_its_own_axes_and_zooms(turn, zoom):
    model = made().model
    draws = np.zeros((len(PLACES), draws_of(model)), np.float32)
    parts = split_draws(model, draws)  # views
    parts["turn"][:], parts["zoom"][:] = turn, zoom
    render = OpenGLRenderer(model, [0, 1], SIZE, Look(camera_turn=1.0, zoom=1.0))
    seen = np.asarray(render(poses(), jnp.asarray(draws))).reshape(len(PLACES), 2, SIZE, SIZE, 3)
    quaternion, about, far = np.empty(4), np.empty(9), 0.0
    mujoco.mju_axisAngle2Quat(quaternion, np.sign(turn), np.linalg.norm(turn))
    mujoco.mju_quat2Mat(about, quaternion)
    for camera, still in enumerate(describe_cameras(model, ("front", "side"), SIZE)):
        focal = SIZE / 2 / np.tan(np.deg2rad(still["fovy"] * (1.0 + zoom)) / 2)
        rotation = np.array(still["rotation"]) @ about.reshape(3, 3)
        moved = still | {"rotation": rotation, "intrinsics": still["intrinsics"] | {"fx": focal, "fy": focal}}
        for scene, place in enumerate(PLACES):
            expected = pixel(moved, place)
            if (expected < 3).any() or (expected > SIZE - 3).any():
                continue  # out of the picture
            far = max(far, np.abs(expected - pixel(still, place)).max())
            np.testing.assert_allclose(orange(seen[scene, camera])[0], expected, atol=2.0)
    assert far > 4.0  # twice the tolerance


def test_the_marker_is_seen_at_the_goal_and_what_is_hidden_changes_nothing():
    pictures, without = made(target="seen"), made()
    goals = np.array([[1.2, 0.65, 0.5], [1.2, 0.9, 0.7], [1.5, 0.85, 0.45], [1.45, 0.95, 0.6]])
    none, see = jnp.zeros((len(goals), pictures.draws)), jax.jit(pictures)
    seen = np.asarray(see(jnp.concatenate([poses(), goals], axis=1), none))
    for camera, described in enumerate(describe_cameras(pictures.model, pictures.cameras, SIZE)):
        for scene, goal in enumerate(goals):
            where, count = red(seen[scene, camera])
            assert count >= 4
            np.testing.assert_allclose(where, pixel(described, goal), atol=1.0)
    below = np.asarray(see(jnp.concatenate([poses(), goals - [0.0, 0.0, 3.0]], axis=1), none))
    np.testing.assert_array_equal(below, without(poses(), jnp.zeros((len(goals), without.draws))))


@pytest.mark.parametrize("task", ["grasp", "stack"])
def test_a_scene_that_shows_the_goal_has_no_marker(task):
    assert not Pictures(hgail_envs.make(task), target="seen").marker


def test_each_scene_comes_back_in_its_place_under_vmaps_and_scans():
    pictures = made("varied")
    draws = jax.random.uniform(jax.random.key(0), (4, pictures.draws), minval=-1.0)
    alone = np.stack(
        [np.asarray(pictures(qpos[None], draw[None]))[0] for qpos, draw in zip(poses(), draws, strict=True)]
    )
    assert len({picture.tobytes() for picture in alone}) == 4

    def in_time(qpos, draws):
        return jax.lax.scan(lambda _, scene: (None, pictures(*scene)), None, (qpos[:, None], draws[:, None]))[1]

    nested = jax.jit(jax.vmap(in_time))(poses().reshape(2, 2, -1), draws.reshape(2, 2, -1))
    np.testing.assert_array_equal(np.asarray(nested).reshape(alone.shape), alone)


def test_a_look_varies_pictures_and_leaves_no_trace_in_the_next():
    pictures, qpos = made("varied"), poses()[:1]
    none = jnp.zeros((1, pictures.draws))
    plain = np.asarray(pictures(qpos, none), int)
    other = np.asarray(pictures(qpos, jnp.ones_like(none)), int)
    assert np.abs(other - plain).mean() > 5.0
    np.testing.assert_array_equal(np.asarray(pictures(qpos, none), int), plain)


def test_things_stand_where_the_draws_put_them_and_hide_no_cube():
    pictures = made("things")
    none = np.zeros((1, pictures.draws), np.float32)
    moved = none.copy()
    moved[0, -3:-1] = 1.0  # the last thing, a ball on the table's rim: 20 cm along x and 2 cm along y
    described = describe_cameras(pictures.model, pictures.cameras, SIZE)
    one, other = (np.asarray(pictures(poses()[:1], draws))[0] for draws in (none, moved))
    changed = (one != other).any(axis=-1)
    for camera, mask in zip(described, changed, strict=True):
        rows, columns = np.nonzero(mask)
        places = [pixel(camera, np.array(place)) for place in ([1.3, 0.44, 0.43], [1.5, 0.46, 0.43])]
        low, high = np.min(places, axis=0) - 6.0, np.max(places, axis=0) + 6.0  # with shadows
        assert mask.any() and (low[0] <= columns).all() and (columns <= high[0]).all()
        assert (low[1] <= rows).all() and (rows <= high[1]).all()
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, (40, pictures.draws)).astype(np.float32)
    draws[:, :-JOINTS] = 0.0  # things alone
    for seen in np.asarray(pictures(jnp.repeat(poses()[1:2], 40, axis=0), jnp.asarray(draws))):
        for camera, picture in zip(described, seen, strict=True):
            np.testing.assert_allclose(orange(picture)[0], pixel(camera, PLACES[1]), atol=2.0)


def test_the_wrist_camera_moves_with_the_hand_and_sees_the_fingers_end():
    pictures, env = made(cameras=("wrist",)), push()
    data = mujoco.MjData(pictures.model)
    data.qpos[:] = env._start_qpos
    mujoco.mj_forward(pictures.model, data)
    towards = data.site("grip").xpos - data.camera("wrist").xpos
    axis = -data.camera("wrist").xmat.reshape(3, 3)[:, 2]
    assert axis @ towards / np.linalg.norm(towards) > np.cos(np.deg2rad(30.0))
    assert axis[2] < -0.7  # down, at the table


def test_the_physics_has_no_camera():
    assert push().model.ncam == 0


def test_wrong_uses_are_refused_in_one_line(monkeypatch):
    env, find_spec = push(), importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "warp" else find_spec(name))
    for options, message in (
        ({"cameras": ["nose"]}, "scene push has no camera 'nose'; it has front, side, wrist"),
        ({"cameras": []}, "no camera is named; choose from front, side, wrist"),
        ({"cameras": ["side", "side"]}, "a camera is named twice in side, side"),
        ({"size": 8}, "the size of a picture is 8; it must be at least 16"),
        ({"renderer": "warp"}, "the renderer 'warp' needs warp-lang, the extra warp; use 'opengl' or 'auto'"),
        ({"renderer": "pencil"}, "pencil"),
        ({"look": "odd"}, "odd"),
        ({"target": "felt"}, "target is 'felt'; choose from given, seen"),
        ({"kind": "heat"}, "kind is 'heat'; choose from colour, depth"),
    ):
        with pytest.raises(ValueError, match=message):
            Pictures(env, **options)
    with pytest.raises(ValueError, match="the task has no scene that a camera could see"):
        Pictures(hgail_envs.make("point"))
    bare = copy.copy(env.model)
    with pytest.raises(ValueError, match="scene push has no camera; give its MJCF a <camera>"):
        camera_ids(bare, "push", ["front"])


@pytest.mark.parametrize(
    ("renderer", "message"),
    [("auto", "install the extra warp, or set JAX_PLATFORMS=cpu"), ("opengl", "'opengl' is for programs on a CPU")],
)
def test_a_gpu_without_warp_is_refused_before_anything_is_compiled(renderer, message, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=message):
        resolve_renderer(renderer)


def test_each_row_comes_back_in_its_place_from_one_batch_of_all():
    """Vmaps around a function of a batch become a larger batch."""
    sizes = []

    def add(one, other):
        sizes.append(len(one))
        return one[:, :2] * 10.0 + other

    function, one, other = as_one_batch(add), jnp.arange(24.0).reshape(2, 4, 3), jnp.arange(4.0).reshape(4, 1)

    def scanned(one):
        return jax.lax.scan(lambda total, _: (total + 1.0, function(one + total, other)), 0.0, None, 3)[1]

    results = jax.jit(jax.vmap(scanned))(one)
    expected = np.stack([10.0 * (one[..., :2] + step) + other for step in range(3)], axis=1)
    np.testing.assert_array_equal(results, expected)
    assert sizes[-1] == 8

import ctypes.util
import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.transfer.camera import Camera, intrinsics, look_at
from hgail_envs.vision.rendering import headless_backend, open_renderer
from tests.support import ROOT

WIDTH, HEIGHT = 160, 120
BALL, BOX = np.array([-0.1, 0.12, 0.1]), np.array([0.1, -0.07, 0.05])
HALF = np.array([0.03, 0.02, 0.05])
SCENE = f"""
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="plane" type="plane" size="3 3 .1"/>
    <geom name="ball" type="sphere" size="0.02" pos="{" ".join(map(str, BALL))}"/>
    <geom name="box" type="box" size="{" ".join(map(str, HALF))}" pos="{" ".join(map(str, BOX))}" euler="0 0 30"/>
    <camera name="slanted" pos="0.6 0.2 0.9" xyaxes="-.316 .949 0 -.8 -.27 .54" fovy="40"/>
  </worldbody>
</mujoco>
"""
numbers = st.floats(-1.0, 1.0)


@pytest.fixture(scope="module")
def scene():
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.fixture(scope="module")
def camera(scene):
    """The scene's camera; MuJoCo's axes are x right, y up, z backward."""
    model, data = scene
    view = data.camera("slanted")
    rotation = view.xmat.reshape(3, 3) * [1.0, -1.0, -1.0]
    matrix = intrinsics(WIDTH, HEIGHT, float(model.camera("slanted").fovy[0]))
    return Camera(WIDTH, HEIGHT, matrix, rotation, view.xpos.copy())


@pytest.fixture(scope="module")
def seen(scene, rendering):
    """Depth and geom of each pixel, as MuJoCo's renderer has them."""
    model, data = scene
    with open_renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(data, "slanted")
        renderer.enable_depth_rendering()
        depth = renderer.render().copy()
        renderer.disable_depth_rendering()
        renderer.enable_segmentation_rendering()
        return depth, renderer.render()[..., 0].copy()


def pixel_grid():
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([columns + 0.5, rows + 0.5], axis=-1)


def test_every_pixel_lies_on_the_surface_that_it_shows(scene, seen, camera):
    model, data = scene
    depth, shown = seen
    points = camera.to_world(pixel_grid(), depth)
    assert np.bincount(shown.ravel()).min() > 20  # each of the three is in the picture
    np.testing.assert_allclose(points[shown == model.geom("plane").id][:, 2], 0.0, atol=1e-5)
    radii = np.linalg.norm(points[shown == model.geom("ball").id] - BALL, axis=-1)
    np.testing.assert_allclose(radii, 0.02, atol=5e-4)  # MuJoCo draws a polyhedron
    in_box = (points[shown == model.geom("box").id] - BOX) @ data.geom("box").xmat.reshape(3, 3)
    np.testing.assert_allclose(np.max(np.abs(in_box) / HALF, axis=-1), 1.0, atol=1e-3)


def test_a_small_ball_is_where_it_projects_to(scene, seen, camera):
    depth, shown = seen
    is_ball = shown == scene[0].geom("ball").id
    pixel, distance = camera.to_pixels(BALL)
    np.testing.assert_allclose(pixel_grid()[is_ball].mean(axis=0), pixel, atol=0.3)
    assert depth[is_ball].min() == pytest.approx(distance - 0.02, abs=1e-3)


def test_where_nothing_renders_it_says_what_to_install(monkeypatch, scene):
    def no_library(*_):
        raise ImportError("no libEGL")

    monkeypatch.setattr("mujoco.rendering.classic.renderer.Renderer", no_library)
    with pytest.raises(RuntimeError, match=r"install EGL or OSMesa \(no libEGL\)"):
        open_renderer(scene[0], HEIGHT, WIDTH)


# The file alone, which takes a tenth of the time that importing the package does.
OPEN = f"""
import mujoco, runpy
names = runpy.run_path({str(ROOT / "envs/hgail_envs/vision/rendering.py")!r})
try:
    with names["open_renderer"](mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8) as renderer:
        print(type(renderer._gl_context).__module__)
except names["RenderingError"] as error:
    print(error)
"""


def what_opens(**variables):
    """Returns what renders in a process with these environment variables, or why nothing does."""
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "MUJOCO_GL")}
    environment |= variables
    return subprocess.run(
        [sys.executable, "-c", OPEN], env=environment, capture_output=True, text=True, check=True
    ).stdout.strip()


@pytest.mark.skipif(sys.platform != "linux", reason="a Mac has one renderer, which MUJOCO_GL does not choose")
def test_what_renders_is_what_is_there_or_what_is_chosen(rendering):
    found = headless_backend(ctypes.util.find_library)
    assert what_opens() == what_opens(MUJOCO_GL=found) == f"mujoco.{found}"


@pytest.mark.skipif(sys.platform != "linux", reason="a Mac has one renderer, which MUJOCO_GL does not choose")
def test_without_a_renderer_the_physics_is_there_and_a_picture_is_refused():
    refused = "MuJoCo cannot render: MUJOCO_GL is 'disable'; choose from egl, osmesa, glfw"
    assert what_opens(MUJOCO_GL="disable") == refused


def test_equation_8_by_hand():
    """Looking along the world's x, with y to the left: what is right in the image has a smaller y, what is down z."""
    rotation = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    camera = Camera(640, 480, np.array([[500.0, 0, 320], [0, 400.0, 240], [0, 0, 1]]), rotation, np.array([1.0, 2, 3]))
    pixels = np.array([[[320.0, 240.0], [420.0, 240.0], [320.0, 280.0]]])
    points = camera.to_world(pixels, np.array([[2.0, 2.0, 4.0]]))
    np.testing.assert_allclose(points, [[[3.0, 2.0, 3.0], [3.0, 1.6, 3.0], [5.0, 2.0, 2.6]]])


@settings(deadline=None, derandomize=True, database=None)  # so that it never fails by chance
@given(st.tuples(numbers, numbers, numbers), st.tuples(numbers, numbers, st.floats(0.1, 1.0)))
def test_to_pixels_and_back(where, at):
    camera = look_at(np.array([0.1, 0.2, 3.0]) + where, np.array(at), 45.0, 64, 48).moved(np.array(where), np.array(at))
    points = camera.position + np.array([[0.3, 0.1, 2.0], [-0.5, 0.4, 1.0]]) @ camera.rotation.T
    pixels, depth = camera.to_pixels(points)
    np.testing.assert_allclose(depth, [2.0, 1.0])
    np.testing.assert_allclose(camera.to_world(pixels, depth), points, atol=1e-9)


def test_the_target_is_in_the_middle_and_up_is_up():
    camera = look_at(np.array([1.0, 2.0, 3.0]), np.array([0.5, 0.5, 0.5]), 30.0, 64, 48)
    (middle, above), _ = camera.to_pixels(np.array([[0.5, 0.5, 0.5], [0.5, 0.5, 0.6]]))
    np.testing.assert_allclose(middle, [32.0, 24.0])
    assert above[0] == pytest.approx(32.0)
    assert above[1] < 24.0


def test_a_turned_camera_errs_by_the_angle_times_the_distance():
    camera = look_at(np.array([0.0, -2.0, 0.0]), np.zeros(3), 30.0, 64, 48)
    middle = np.array([32.0, 24.0])
    turned = camera.moved(np.radians([0.5, 0.0, 0.0]), np.zeros(3))
    error = turned.to_world(middle, np.array(2.0)) - camera.to_world(middle, np.array(2.0))
    np.testing.assert_allclose(error, [0.0, 0.0, 2.0 * np.sin(np.radians(0.5))], atol=1e-4)
    shifted = camera.moved(np.zeros(3), np.array([0.01, 0.02, 0.03]))
    np.testing.assert_allclose(shifted.to_world(middle, np.array(2.0)), [0.01, 0.02, 0.03], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "0 by 48 pixels"),
        ({"matrix": np.zeros((3, 3))}, "positive focal lengths"),
        ({"rotation": np.diag([1.0, 1.0, -1.0])}, "rotation matrix"),
    ],
)
def test_a_camera_that_cannot_be(change, message):
    good = {"width": 64, "height": 48, "matrix": intrinsics(64, 48, 45.0), "rotation": np.eye(3)}
    with pytest.raises(ValueError, match=message):
        Camera(**(good | change), position=np.zeros(3))


def test_looking_straight_down_is_refused():
    with pytest.raises(ValueError, match="straight up or down"):
        look_at(np.array([0.0, 0.0, 1.0]), np.zeros(3), 45.0, 64, 48)

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

numbers = st.floats(-1.0, 1.0)


def test_where_nothing_renders_it_says_what_to_install(monkeypatch):
    def no_library(*_):
        raise ImportError("no libEGL")

    monkeypatch.setattr("mujoco.rendering.classic.renderer.Renderer", no_library)
    with pytest.raises(RuntimeError, match=r"install EGL or OSMesa \(no libEGL\)"):
        open_renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8)


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


def test_the_angle_of_view_is_from_the_top_row_to_the_bottom_row():
    camera = look_at(np.array([0.0, -2.0, 0.0]), np.zeros(3), 30.0, 64, 48)
    half = 2.0 * np.tan(np.radians(15.0))
    (top, right), _ = camera.to_pixels(half * np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]))
    np.testing.assert_allclose([top, right], [[32.0, 0.0], [56.0, 24.0]], atol=1e-9)

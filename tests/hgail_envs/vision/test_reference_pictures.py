"""Pictures of the reference's scene show what stands there where our cameras would have it."""

import numpy as np
import pytest

import hgail_envs
from hgail_envs.tasks.reference import ReferenceFetch
from hgail_envs.vision.cameras import describe_cameras
from hgail_envs.vision.depth import FAR
from hgail_envs.vision.reference_pictures import ReferencePictures
from tests.hgail_envs.vision.test_pictures import middle, pixel

pytestmark = pytest.mark.usefixtures("rendering")
SIZE, CAMERAS = 128, ("front", "side")


@pytest.fixture(scope="module")
def seen():
    """The task and the reference, and its pictures with the marker and without it."""
    pytest.importorskip("gymnasium_robotics")
    task, reference = hgail_envs.make("push"), ReferenceFetch("push")
    return task, reference, *(ReferencePictures(reference, task, CAMERAS, SIZE, marker) for marker in (True, False))


def black(picture):
    return (picture.max(axis=-1) < 70) & (np.ptp(picture, axis=-1) < 10)


def test_cube_and_target_are_where_a_pinhole_camera_of_ours_has_them(seen):
    task, reference, marked, unmarked = seen
    described, found = describe_cameras(task.robot.load(visual=True), CAMERAS, SIZE), 0
    for episode in range(6):
        reference.reset(np.random.default_rng(episode))
        cube = reference.carried()
        reference.data.qpos[:2] += 5.0  # the robot goes out of the picture
        with_it, without = marked(), unmarked()
        assert with_it.shape == (2, SIZE, SIZE, 3) and with_it.dtype == np.uint8
        for camera, one, other in zip(described, with_it, without, strict=True):
            changed = (one != other).any(axis=-1)
            where, count = middle(changed)
            assert count > 4
            np.testing.assert_allclose(where, pixel(camera, reference.target()), atol=2.5)  # the cube may hide a part
            x, y = np.floor(pixel(camera, cube)).astype(int)
            near = other[y - 1 : y + 2, x - 1 : x + 2]
            found += black(near).all()
    assert found == 12


def test_distances_are_those_of_table_and_cube_and_marker(seen):
    task, reference, *_ = seen
    see = ReferencePictures(reference, task, CAMERAS, SIZE, True, "depth")
    described = describe_cameras(task.robot.load(visual=True), CAMERAS, SIZE)
    for episode in (0, 1, 3):  # in 2 the cube hides the marker
        reference.reset(np.random.default_rng(episode))
        reference.data.qpos[:2] += 5.0  # the robot goes out of the picture
        pictures = see()
        assert pictures.shape == (2, SIZE, SIZE, 1) and pictures.dtype == np.uint8
        cube = reference.carried() + np.array([0.0, 0.0, 0.025])  # the middle of its upper side
        for camera, picture in zip(described, pictures, strict=True):
            axis, place = -np.array(camera["rotation"])[:, 2], np.array(camera["position"])
            towards = (place - reference.target()) / np.linalg.norm(place - reference.target())
            for point in (cube, reference.target() + 0.02 * towards, [1.08, 0.45, 0.4], [1.5, 1.05, 0.4]):
                x, y = np.floor(pixel(camera, point)).astype(int)
                expected = 255.0 * (axis @ (point - place)) / FAR
                assert picture[y, x, 0] == pytest.approx(expected, abs=2)  # a pixel is a centimetre of the table


def test_the_wrist_camera_is_on_the_hand(seen):
    task, reference, *_ = seen
    see = ReferencePictures(reference, task, ["wrist"], SIZE, False)
    reference.reset(np.random.default_rng(0))
    before = see()
    reference.step(np.array([1.0, 1.0, 0.0, 0.0]))
    lower = before[0, -SIZE // 8 :]
    np.testing.assert_allclose(see()[0, -SIZE // 8 :].astype(int), lower, atol=12)  # the hand, still in its place
    assert (see() != before).any()


def test_a_camera_that_the_scene_lacks_is_refused(seen):
    with pytest.raises(ValueError, match="scene push has no camera 'nose'"):
        ReferencePictures(seen[1], seen[0], ["nose"], SIZE, False)

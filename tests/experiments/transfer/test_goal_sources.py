"""What cameras over the workspace say of a target."""

import types
import typing

import mujoco
import numpy as np
import pytest

from experiments.transfer.conditions import Conditions
from experiments.transfer.episode import run_episode
from experiments.transfer.goal_sources import (
    ABOVE,
    CALIBRATED,
    GOAL_SOURCES,
    LOOK_EVERY,
    CameraNoise,
    TargetNotSeenError,
    camera_estimate,
    measure,
    overhead,
)
from experiments.transfer.robots import make_robot

START, OFFSET = np.array([0.1, 0.0, 0.5]), np.array([1.0, 2.0, 3.0])
SCENE = """<mujoco><worldbody><geom type="plane" size="2 2 .1"/>
  <body name="cube" pos="0 0 .45"><freejoint/><geom name="cube" type="box" size=".025 .025 .025"/></body>
  <body mocap="true" pos="0 0 .7"><geom type="box" size=".1 .1 .01"/></body></worldbody></mujoco>"""


def robot_of(task, lid=(0.0, 0.0, 9.0)):
    """A robot whose hand is at `START` in a scene with a cube and a lid, as far as cameras are concerned."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    data.mocap_pos[0] = lid
    mujoco.mj_forward(model, data)
    features = np.append(START + OFFSET, np.zeros(5))
    return types.SimpleNamespace(
        task=task, model=model, data=data, offset=OFFSET, cube="cube", reset=lambda rng: None, features=lambda: features
    )


@pytest.mark.parametrize("source", ["camera", "one-camera"])
@pytest.mark.parametrize(("task", "place"), [("reach", [0.2, -0.1, 0.6]), ("grasp", [0.0, 0.0, 0.45])])
def test_exact_cameras_see_the_target_where_it_is_in_the_policy_s_frame(source, task, place):
    look = GOAL_SOURCES[source](robot_of(task))(np.random.default_rng(0))
    np.testing.assert_allclose(look(OFFSET + place), OFFSET + place, atol=1e-9)


def test_a_target_behind_something_is_seen_from_elsewhere_or_not_at_all():
    above = overhead(START, ABOVE)[0].position
    place = np.array([0.1, 0.05, 0.45])
    robot = robot_of("reach", lid=place + 0.5 * (above - place))
    with pytest.raises(TargetNotSeenError, match="none of 1 cameras sees the target"):
        camera_estimate(robot, ABOVE)(np.random.default_rng(0))(place + OFFSET)
    np.testing.assert_allclose(camera_estimate(robot)(np.random.default_rng(0))(place + OFFSET), place + OFFSET)
    with pytest.raises(TargetNotSeenError):  # within the cube, which no goal of reach can be seen in
        camera_estimate(robot_of("reach"))(np.random.default_rng(0))(np.array([0.0, 0.0, 0.45]) + OFFSET)


def test_a_cube_is_looked_at_every_few_steps_and_a_hidden_one_stays_where_it_was():
    robot, lid_on = robot_of("grasp"), {2, 4}
    look, seen = camera_estimate(robot, ABOVE)(np.random.default_rng(0)), []
    for step in range(5 * LOOK_EVERY):
        place = np.array([0.001 * step, 0.0, 0.45])
        robot.data.qpos[:3] = place
        robot.data.mocap_pos[0] = np.add(place, [0.0, 0.0, 0.1 if step // LOOK_EVERY in lid_on else 9.0])
        mujoco.mj_forward(robot.model, robot.data)
        seen.append(look(place + OFFSET)[0] - OFFSET[0])
    np.testing.assert_allclose(seen, np.repeat([0.0, 0.005, 0.005, 0.015, 0.015], LOOK_EVERY), atol=1e-9)


@pytest.mark.parametrize(
    ("noise", "along", "across"),
    [
        (CameraNoise(depth=0.01), 0.01, 0.0),
        (CameraNoise(pixel=1.0), 0.0, np.tan(np.radians(17.0)) / 64),  # of a metre, seen by half of 128 pixels
        (CameraNoise(rotation=0.5), 0.0, np.radians(0.5)),
        (CameraNoise(translation=0.01), 0.01, 0.01),
    ],
    ids=["depth", "pixel", "rotation", "translation"],
)
def test_errors_are_as_large_as_the_noise_of_a_camera_a_metre_away(noise, along, across):
    (camera,), rng = overhead(START, ABOVE), np.random.default_rng(0)
    middle = camera.position + camera.rotation[:, 2]
    off = np.array([measure(camera, middle, noise, rng) - middle for _ in range(2000)]) @ camera.rotation
    np.testing.assert_allclose(off.std(axis=0), [across, across, along], rtol=0.06, atol=1e-4)


def test_sources_have_the_cameras_and_the_noise_that_they_are_said_to():
    """Of a target that two cameras see with independent errors, the mean has errors smaller by √2."""
    place, robot = np.add(OFFSET, [0.1, 0.0, 0.5]), robot_of("reach")

    def spread(source):
        looks = [GOAL_SOURCES[source](robot)(np.random.default_rng(seed))(place) for seed in range(300)]
        return np.linalg.norm(np.std(looks, axis=0))

    assert spread("camera") < 1e-9 and spread("one-camera") < 1e-9
    (camera,), rng = overhead(START, ABOVE), np.random.default_rng(0)
    alone = np.linalg.norm(np.std([measure(camera, place - OFFSET, CALIBRATED, rng) for _ in range(2000)], axis=0))
    assert spread("one-noisy-camera") == pytest.approx(alone, rel=0.1)
    assert spread("noisy-cameras") == pytest.approx(alone / np.sqrt(2), rel=0.1)


def test_cameras_follow_a_cube_that_is_pushed():
    """A closed hand pushes it by more than the estimate is off; what cameras see of it, against the simulation."""

    class Push:
        task_options: typing.ClassVar = {"cube": "tracked"}
        seen: typing.ClassVar[list] = []

        def __call__(self, observation):
            self.seen.append(observation[11:14])
            places.append(robot.target())
            return np.append([0.4, 0.4, 1.0] * np.clip(20 * (observation[11:14] - observation[:3]), -1, 1), -1.0)

    robot, places = make_robot("gymnasium", "grasp"), []
    conditions = Conditions(GOAL_SOURCES["camera"](robot))
    robot.reset(np.random.default_rng(0))
    run_episode(robot, policy := Push(), np.random.default_rng(0), conditions)
    looks = slice(0, 21, LOOK_EVERY)
    moved = np.linalg.norm(np.array(places)[looks] - places[0], axis=1)
    assert moved[-1] > 0.05
    np.testing.assert_allclose(np.array(policy.seen)[looks], np.array(places)[looks], atol=0.01)

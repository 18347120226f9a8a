"""The UR5e moves as the Fetch does, and policies trained on the Fetch drive it."""

import itertools

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from experiments.transfer.episode import run_episode, run_episodes
from experiments.transfer.robots import GymnasiumFetch
from experiments.transfer.robots.arms import TOOL_CENTRE, UR5E, load_arm
from experiments.transfer.robots.inverse_kinematics import DownwardArm
from experiments.transfer.robots.responses import FingerResponse, GripperResponse
from experiments.transfer.robots.servo_arm import Franka, UR5e
from hgail_envs.scenes import TABLE_HEIGHT, assets_directory
from hgail_envs.tasks.arm import CONTROL_PERIOD
from hgail_envs.tasks.grasp import Grasp
from hgail_jax.io.policy import load_policy
from tests.support import move


@pytest.fixture(scope="module")
def grasp():
    return UR5e("grasp")


@pytest.fixture(scope="module")
def fetch():
    return GymnasiumFetch("grasp")


PUSH = [[-1.0, 0.0, 0.0, 1.0]] * 4 + [[0.0, 0.0, 0.0, 1.0]] * 3
SIDE = [[0.0, 1.0, 0.0, 1.0]] * 4 + [[0.0, 0.0, 0.0, 1.0]] * 3


@pytest.mark.parametrize("actions", [PUSH, SIDE])
def test_the_tool_answers_as_the_fetch_s_gripper(grasp, fetch, actions):
    """About 33 mm for a unit action, stopping within one, without turning; velocities too are the Fetch's."""
    ours, theirs = move(grasp, actions), move(fetch, actions)
    np.testing.assert_allclose(ours[0, :3], theirs[0, :3], atol=2e-3)
    np.testing.assert_allclose(np.diff(ours[:, :3], axis=0), np.diff(theirs[:, :3], axis=0), atol=2e-3)
    np.testing.assert_allclose(ours[:, 3:6], theirs[:, 3:6], atol=4e-3)
    tool = grasp.data.site(TOOL_CENTRE).xmat.reshape(3, 3)
    assert tool[2, 2] < -0.999


def test_the_hand_opens_and_closes(grasp):
    seen = move(grasp, [[0.0, 0.0, 0.0, 1.0]] * 6 + [[0.0, 0.0, 0.0, -1.0]] * 6)
    assert seen[0, 6] == pytest.approx(0.0, abs=2e-3)
    assert seen[6, 6] == pytest.approx(0.085, abs=1e-3)
    assert seen[12, 6] == pytest.approx(0.0, abs=5e-3)
    assert not seen[:, 7].any()


def test_the_gap_is_the_distance_between_the_pads(grasp):
    check_the_gap(grasp)


def check_the_gap(robot):
    robot.reset(np.random.default_rng(0))
    for hand in [1.0] * 3 + [-1.0] * 2:  # a third would press the pads together, beyond a gap of 0
        robot.step(np.array([0.0, 0.0, 0.3, hand]))
        assert robot.features()[6] == pytest.approx(_distance_of_pads(robot), abs=3e-3)


def test_an_open_hand_is_led_past_its_widest_and_closes_later(grasp):
    seen = move(grasp, [[0.0, 0.0, 0.0, 1.0]] * 5 + [[0.0, 0.0, 0.0, -1.0]] * 2)
    assert 0.075 < seen[6, 6] < 0.082  # 0.067 if it were led no farther than it opens
    assert seen[7, 6] < 0.04


def _distance_of_pads(robot):
    model, data = robot.model, robot.data
    one, other = (
        [geom for geom in np.flatnonzero(model.geom_bodyid == model.body(pad).id) if model.geom_contype[geom]]
        for pad in robot.arm.hand.pads
    )
    pairs = itertools.product(one, other)
    return min(mujoco.mj_geomDistance(model, data, int(a), int(b), 0.2, np.zeros(6)) for a, b in pairs)


def test_the_hand_starts_open_where_that_is_asked_for():
    robot = UR5e("grasp", start_open=True)
    robot.reset(np.random.default_rng(0))
    assert robot.features()[6] == pytest.approx(0.085, abs=1e-3)


@pytest.mark.parametrize("hand", [1.0, -1.0])
def test_the_hand_comes_down_to_the_table_and_is_not_pressed_into_it(grasp, hand):
    check_the_table_is_not_pressed(grasp, hand)


def check_the_table_is_not_pressed(grasp, hand):
    """The tool is led down as far as it goes, the hand open or closed."""
    grasp.reset(np.random.default_rng(0))
    height = []
    for _ in range(16):
        grasp.step(np.array([0.0, 0.0, -1.0, hand]))
        height.append(grasp.features()[2] - TABLE_HEIGHT)
    assert height[-1] == pytest.approx(grasp.arm.hand.below_tool, abs=2e-3)
    assert min(height) > grasp.arm.hand.below_tool - 3e-3
    assert (
        sum(pressing(grasp.model, grasp.data)) < 10.0
    )  # newtons; without a floor 350 of the UR5e and 200 of the Franka


def pressing(model, data):
    """Yields the normal forces between the hand and the table."""
    for index, pair in enumerate(data.contact.geom):
        bodies, force = {model.body(model.geom_bodyid[geom]).name for geom in pair}, np.zeros(6)
        if "world" in bodies and "cube" not in bodies:
            mujoco.mj_contactForce(model, data, index, force)
            yield force[0]


def test_velocity_is_metres_an_action(grasp):
    grasp.reset(np.random.default_rng(0))
    grasp.step(np.array([0.5, 0.3, -0.2, 0.0]))
    velocity, site = np.zeros(6), grasp.model.site(TOOL_CENTRE).id
    mujoco.mj_objectVelocity(grasp.model, grasp.data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 0)
    np.testing.assert_allclose(grasp.features()[3:6], 4 * CONTROL_PERIOD * velocity[3:], atol=1e-6)


def test_targets_are_drawn_as_the_fetch_s(grasp):
    offsets = []
    for seed in range(50):
        grasp.reset(np.random.default_rng(seed))
        offsets.append(grasp.target() - grasp.features()[:3])
    offsets = np.array(offsets)
    assert np.abs(offsets[:, :2]).max() <= 0.151
    assert np.linalg.norm(offsets[:, :2], axis=1).min() >= 0.099
    np.testing.assert_allclose(grasp.target()[2], 0.425, atol=1e-3)


def test_a_controller_grasps_and_a_closed_hand_does_not(grasp):
    for controller, grasped in ((Grasp.controllers["from-above"], 1.0), (Grasp.controllers["closed"], 0.0)):
        grasp.reset(np.random.default_rng(2))
        outcome = run_episode(
            grasp, lambda seen, act=controller: np.asarray(act(jnp.asarray(seen))), np.random.default_rng(0)
        )
        assert outcome.success == outcome.achieved == grasped


def test_a_policy_trained_on_the_fetch_reaches(shipped_policy):
    outcomes = run_episodes(UR5e("reach"), [load_policy(shipped_policy)], range(6))
    assert all(outcome.success for outcome in outcomes)


def test_a_policy_trained_on_the_fetch_grasps(grasp):
    policy = load_policy(assets_directory() / "policies" / "grasp-other-arms.npz")
    outcomes = run_episodes(grasp, [policy], range(6))
    assert sum(outcome.success for outcome in outcomes) >= 5  # 99 % of 400; hardly any with a hand led otherwise


@pytest.mark.slow
@pytest.mark.parametrize("arm", [UR5e, Franka])
def test_policies_trained_on_the_fetch_pick_and_place(arm):
    """Plain; of 400 episodes the UR5e has 0.97, the Franka 0.99."""
    policy = load_policy(assets_directory() / "policies" / "pick-and-place.npz")
    outcomes = run_episodes(arm("pick-and-place"), [policy], range(20))
    assert sum(outcome.success for outcome in outcomes) >= 17


def test_pick_and_place_shows_the_cube_and_where_it_is_to_go():
    """Features as `PickAndPlace` has them, of the scene's own quantities."""
    robot = UR5e("pick-and-place")
    heights = []
    for seed in range(20):
        robot.reset(np.random.default_rng(seed))
        heights.append(robot.target()[2] - 0.425)
    assert sum(height < 1e-6 for height in heights) in range(4, 17)  # half of them on the table
    assert 0.2 < max(heights) < 0.45
    robot.step(np.array([0.5, 0.3, -0.2, 0.0]))
    seen, cube = robot.features(), robot.data.joint("cube")
    np.testing.assert_allclose(seen[9:12], cube.qpos[:3] + robot.offset, atol=1e-6)
    np.testing.assert_allclose(seen[6:9], seen[9:12] - seen[:3], atol=1e-6)
    np.testing.assert_allclose(seen[12:15], cube.qvel[:3] * 4 * CONTROL_PERIOD, atol=1e-6)
    assert seen.shape == (17,)
    np.testing.assert_allclose(robot.carried(), seen[9:12])
    assert not robot.reached()


def test_joints_keep_to_their_speed():
    arm = DownwardArm(load_arm(UR5E), TOOL_CENTRE, np.diag([1.0, -1.0, -1.0]), top_speed=[np.pi] * 6)
    velocities = arm.approach(np.array([0.3, 0.5, 0.2]), time=0.01)
    assert np.abs(velocities).max() == pytest.approx(np.pi, rel=1e-3)


def test_responses_are_the_fetch_s():
    """The references alone, against the simulation they stand for."""
    theirs = move(GymnasiumFetch("grasp"), [[-1.0, 0.0, 0.0, 1.0]] * 3 + [[0.0, 0.0, 0.0, -1.0]] * 3)
    gripper, fingers = GripperResponse(theirs[0, :3]), FingerResponse(0.0)
    for number, (last, seen) in enumerate(itertools.pairwise(theirs), start=1):
        before = gripper.position
        target = gripper.lead(gripper.position, np.array([-1.0, 0.0, 0.0]) if number <= 3 else np.zeros(3))
        gripper.follow(target, CONTROL_PERIOD)
        goal = fingers.lead(fingers.gap, 1.0 if number <= 3 else -1.0)
        for _ in range(20):
            fingers.follow(goal, CONTROL_PERIOD / 20)
        np.testing.assert_allclose(gripper.position - before, seen[:3] - last[:3], atol=1e-3)
        assert fingers.gap == pytest.approx(seen[6], abs=8e-3)

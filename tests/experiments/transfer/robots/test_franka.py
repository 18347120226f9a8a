"""The Franka is driven by the same class as the UR5e, from numbers of its own."""

import jax
import numpy as np
import pytest

from experiments.transfer.episode import run_episode, run_episodes
from experiments.transfer.robots import GymnasiumFetch
from experiments.transfer.robots.arms import TOOL_CENTRE
from experiments.transfer.robots.servo_arm import Franka
from hgail_envs.tasks.grasp import Grasp
from hgail_jax.io.policy import load_policy
from tests.experiments.transfer.robots.test_ur5e import PUSH, SIDE, check_the_gap, check_the_table_is_not_pressed
from tests.support import move


@pytest.fixture(scope="module")
def grasp():
    return Franka("grasp")


@pytest.mark.parametrize("actions", [PUSH, SIDE])
def test_the_tool_answers_as_the_fetch_s_gripper(grasp, actions):
    ours, theirs = move(grasp, actions), move(GymnasiumFetch("grasp"), actions)
    np.testing.assert_allclose(ours[0, :3], theirs[0, :3], atol=2e-3)
    np.testing.assert_allclose(np.diff(ours[:, :3], axis=0), np.diff(theirs[:, :3], axis=0), atol=6e-3)
    assert grasp.data.site(TOOL_CENTRE).xmat.reshape(3, 3)[2, 2] < -0.998


def test_the_gap_is_the_distance_between_the_pads(grasp):
    check_the_gap(grasp)


def test_both_fingers_open_alike_as_far_as_they_go(grasp):
    seen = move(grasp, [[0.0, 0.0, 0.0, 1.0]] * 6)
    fingers = [grasp.data.joint(f"robot:panda0_finger_joint{finger}").qpos[0] for finger in (1, 2)]
    assert fingers[0] == pytest.approx(fingers[1], abs=1e-3)
    assert seen[0, 6] == pytest.approx(0.0, abs=3e-3)
    assert seen[6, 6] == pytest.approx(0.08, abs=1e-3)


@pytest.mark.parametrize("hand", [1.0, -1.0])
def test_the_hand_comes_down_to_the_table_and_is_not_pressed_into_it(grasp, hand):
    check_the_table_is_not_pressed(grasp, hand)


def test_a_controller_grasps_and_lifts(grasp):
    grasp.reset(np.random.default_rng(2))
    outcome = run_episode(
        grasp, lambda seen: np.asarray(jax.jit(Grasp.controllers["from-above"])(seen)), np.random.default_rng(0)
    )
    assert outcome.success == 1.0


def test_policies_trained_on_the_fetch_reach_and_grasp(grasp, shipped_policy, grasp_policy):
    reached = run_episodes(Franka("reach"), [load_policy(shipped_policy)], range(2))
    assert all(outcome.success for outcome in reached)
    grasped = run_episodes(grasp, [load_policy(grasp_policy)], range(4))
    assert sum(outcome.success for outcome in grasped) >= 3

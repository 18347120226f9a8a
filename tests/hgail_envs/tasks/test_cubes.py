"""What stack and tower have in common."""

import itertools

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hgail_jax.settings.defaults import DEFAULTS
from tests.hgail_envs.tasks.cubes import CubeScene
from tests.support import check_a_round

WHOSE = {"stack": [(0, 0), (1, 0), (0, 1)], "tower": [(0, 0, 0), *(tuple(row) for row in np.eye(3, dtype=int))]}
CAN_BE_LEFT = {"stack": [(1, 0)], "tower": WHOSE["tower"][1:]}
"""Flags of goals: whose they are, and of these the ones of a cube that the hand lets go of."""


@pytest.fixture(scope="module", params=[pytest.param("stack", marks=pytest.mark.slow), "tower"])
def task(request):
    return request.param


@pytest.fixture(scope="module")
def scene(task):
    return CubeScene(task)


@pytest.fixture(scope="module")
def env(scene):
    return scene.env


def test_the_hand_keeps_still_and_open_while_the_tower_is_tested(scene, env):
    for action in ([1.0, -1.0, 1.0, -1.0], [0.0, 0.0, 0.0, 0.3]):
        np.testing.assert_array_equal(env.lift_test_action(jnp.array(action)), [0, 0, 0, 1])
    start, state, action = scene.begun, scene.begun, jnp.zeros(4)
    for _ in range(env.lift_test_steps):
        action = env.lift_test_action(action)
        state = scene.step(state, action)
    moved = state.pipeline_state.gripper_position - start.pipeline_state.gripper_position
    assert np.abs(moved).max() < 0.02  # gravity makes it sink by a millimetre a step
    assert env.gap(state.pipeline_state) > 0.09
    assert env.lift_test_steps == 12


def test_success_of_goals_is_by_whose_they_are(task, env):
    flags = [(*whose, 0) for whose in WHOSE[task]] + [(*whose, 1) for whose in CAN_BE_LEFT[task]]
    pairs = list(itertools.product(flags, flags))
    desired = np.array([[1.3, 0.7, 0.475, *other] for _, other in pairs], np.float32)
    for shift in ([0.024, 0, 0.009], [0.026, 0, 0], [0, 0.02, 0.011], [0.03, 0.03, 0], [0.04, 0.04, 0]):
        strict, wide = np.hypot(*shift[:2]) <= 0.025 and abs(shift[2]) <= 0.01, np.linalg.norm(shift) <= 0.05
        achieved = np.array([[*np.add([1.3, 0.7, 0.475], shift), *one] for one, _ in pairs], np.float32)
        expected = [one == other and (strict if other[-1] else wide) for one, other in pairs]
        np.testing.assert_array_equal(env.success(achieved, desired), expected)


def test_cubes_that_start_stay_where_they_are(task, scene):
    """In training episodes, in some of which a tower is begun; by C MuJoCo alone."""
    start = scene.starts[1].pipeline_state
    for qpos in start.qpos[:8]:
        data = mujoco.MjData(scene.model)
        data.qpos[:] = qpos
        mujoco.mj_forward(scene.model, data)
        assert np.abs(scene.after_ten_seconds(data, substeps=8)).max() < 2e-3
    assert task == "stack" or 0 < start.placed[:8].sum() < 8


@pytest.mark.slow
@pytest.mark.parametrize("learner", ["ppo", "td3"])
def test_a_round_of_training_runs(task, env, learner):
    check_a_round(env, DEFAULTS[task][learner]["cpu"])

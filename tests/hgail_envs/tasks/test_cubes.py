"""What stack and tower have in common."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hgail_envs
from hgail_jax.settings.defaults import DEFAULTS
from tests.support import check_a_round

WHOSE = {"stack": [(0, 0), (1, 0), (0, 1)], "tower": [(0, 0, 0), *(tuple(row) for row in np.eye(3, dtype=int))]}
CAN_BE_LEFT = {"stack": [(1, 0)], "tower": WHOSE["tower"][1:]}
"""Flags of goals: whose they are, and of these the ones of a cube that the hand lets go of."""


@pytest.fixture(scope="module", params=[pytest.param("stack", marks=pytest.mark.slow), "tower"])
def task(request):
    return request.param


@pytest.fixture(scope="module")
def env(task):
    return hgail_envs.make(task, impl="c", substeps=8)


def test_the_hand_keeps_still_and_open_while_the_tower_is_tested(env):
    for action in ([1.0, -1.0, 1.0, -1.0], [0.0, 0.0, 0.0, 0.3]):
        np.testing.assert_array_equal(env.lift_test_action(jnp.array(action)), [0, 0, 0, 1])
    step, start = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(0))
    state, action = start, jnp.zeros(4)
    for _ in range(env.lift_test_steps):
        action = env.lift_test_action(action)
        state = step(state, action)
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


def test_cubes_that_start_stay_where_they_are(task, env):
    start = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(jax.random.split(jax.random.key(0), 16), True)
    still = jnp.zeros((16, 4))
    end = jax.jit(lambda state: jax.lax.fori_loop(0, 50, lambda _, now: jax.vmap(env.step)(now, still), state))(start)
    first = env._scene_model.object_qpos[:, :1]
    moved = np.asarray(end.pipeline_state.qpos - start.pipeline_state.qpos)[:, first + np.arange(7)]
    assert np.abs(moved).max() < 2e-3
    if task == "tower":
        np.testing.assert_array_equal(end.pipeline_state.placed, start.pipeline_state.placed)
        assert 0 < start.pipeline_state.placed.sum() < 16


@pytest.mark.slow
@pytest.mark.parametrize("learner", ["ppo", "td3"])
def test_a_round_of_training_runs(task, env, learner):
    check_a_round(env, DEFAULTS[task][learner]["cpu"])

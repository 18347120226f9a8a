"""The scene of reach, on C MuJoCo and on MJX-JAX, against Gymnasium-Robotics' FetchReach-v4."""

import functools

import jax
import numpy as np
import pytest

import hgail_envs
from experiments.parity import (
    gripper,
    joint_indices,
    make_counterpart,
    one_step_errors,
    open_loop_drift,
    open_loop_ends,
    place,
    random_moves,
)
from hgail_envs.tasks.base import CONTROL_PERIOD


@functools.cache
def reach_on(impl, substeps=20):
    return hgail_envs.make("reach", impl=impl, substeps=substeps)


@pytest.fixture(scope="module")
def reach():
    return reach_on("c")


@pytest.fixture(scope="module")
def reference(reach):
    return make_counterpart(reach)


@pytest.fixture(scope="module")
def start(reach):
    return reach.reset(jax.random.key(0))


@pytest.fixture(scope="module")
def step(reach):
    return jax.jit(reach.step)


@pytest.fixture(scope="module")
def moves(reference):
    return random_moves(reference)


def test_moves_are_placed_where_the_reference_has_them(reach, reference, moves):
    placed = place(reach, reference, moves.qpos, moves.qvel)
    np.testing.assert_allclose(placed.gripper_position, moves.before, atol=1e-4)
    assert np.ptp(moves.before, axis=0).min() > 0.2  # they go all over the workspace


# MJX leaves out how the weld's Jacobian changes in time, hence its wider bounds.
@pytest.mark.parametrize(
    ("impl", "median_mm", "percentile_mm"), [("c", 0.01, 0.03), pytest.param("jax", 0.4, 1.5, marks=pytest.mark.slow)]
)
def test_one_step_displacement(reference, moves, impl, median_mm, percentile_mm):
    median, percentile = 1000 * np.percentile(one_step_errors(reach_on(impl), reference, moves), [50, 99])
    print(f"one step on {impl}: median {median:.3f} mm, 99th percentile {percentile:.3f} mm")
    assert median <= median_mm
    assert percentile <= percentile_mm


@pytest.fixture(scope="module")
def open_loop(reference):
    """Random actions and where they end."""
    return open_loop_ends(reference)


@pytest.mark.parametrize(
    ("impl", "substeps", "bound_mm"),
    [("c", 20, 10.0), ("c", 4, 20.0), pytest.param("jax", 20, 20.0, marks=pytest.mark.slow)],
)
def test_open_loop_drift(open_loop, impl, substeps, bound_mm):
    """From the reset pose without feedback; an arm that is stretched out soon goes a way of its own."""
    median = 1000 * np.median(open_loop_drift(reach_on(impl, substeps), *open_loop))
    print(f"50 steps open loop on {impl}, {substeps} substeps: median {median:.1f} mm")
    assert median <= bound_mm


def test_rest_pose_and_reset(reference, reach, start):
    np.testing.assert_allclose(reach.initial_gripper_position, reference.initial_gripper_xpos, atol=5e-4)
    joints, _ = joint_indices(reach.model, reference.model)
    np.testing.assert_allclose(start.pipeline_state.qpos, reference.initial_qpos[joints], atol=5e-3)
    observation, _ = reference.reset(seed=0)
    np.testing.assert_allclose(start.info["features"][:3], observation["observation"][:3], atol=5e-4)
    np.testing.assert_allclose(start.info["features"][3:], observation["observation"][5:8], atol=5e-4)


def test_goal_distribution(reference, reach):
    ours = np.asarray(jax.vmap(reach.sample_goal, in_axes=(0, None))(jax.random.split(jax.random.key(3), 4000), None))
    theirs = np.stack([reference.reset(seed=seed)[0]["desired_goal"] for seed in range(400)])
    for goals in (ours, theirs):
        offsets = goals - reach.initial_gripper_position
        assert np.abs(offsets).max() <= 0.1506
    np.testing.assert_allclose(ours.mean(0), theirs.mean(0), atol=0.016)  # 3.5 standard errors
    np.testing.assert_allclose(ours.std(0), theirs.std(0), atol=0.008)


def test_velocity_is_scaled_as_the_reference_s(reference, reach, step, start):
    """After the same actions from rest the observed velocities agree."""
    reference.reset(seed=0)
    state, action = start, np.float32([0.5, -1.0, 0.3, 0.0])
    for _ in range(4):
        state = step(state, action)
        observation = reference.step(action)[0]["observation"]
    np.testing.assert_allclose(state.info["features"][3:], observation[5:8], atol=5e-4)
    assert pytest.approx(reference.dt) == CONTROL_PERIOD


def test_the_table_holds(reference, reach, step, start):
    """Pushed down for long, the gripper rests on the table at the reference's height."""
    reference.reset(seed=0)
    state, action = start, np.float32([0.0, 0.0, -1.0, 0.0])
    for _ in range(12):
        state = step(state, action)
        reference.step(action)
    assert float(state.info["achieved_goal"][2]) == pytest.approx(gripper(reference)[2], abs=2e-3)

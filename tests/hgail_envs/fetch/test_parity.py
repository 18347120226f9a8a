"""The scene of reach, on C MuJoCo and on MJX-JAX, against Gymnasium-Robotics' FetchReach-v4."""

import functools

import jax
import mujoco
import numpy as np
import pytest

import hgail_envs
from hgail_envs.fetch.arm import CONTROL_PERIOD
from hgail_envs.fetch.reference import make_reference

BATCH = 32
PARTS = 12
EPISODES = 8
_NAMES = {
    "base_x": "slide0",
    "base_y": "slide1",
    "base_z": "slide2",
    "torso_lift": "torso_lift_joint",
    "right_finger": "r_gripper_finger_joint",
    "left_finger": "l_gripper_finger_joint",
}


@pytest.fixture(scope="module")
def reference():
    return make_reference("FetchReach-v4")


@pytest.fixture(scope="module")
def reach():
    return hgail_envs.make("reach", impl="c")


@functools.cache
def compiled_step(impl, substeps):
    return jax.jit(jax.vmap(hgail_envs.make("reach", impl=impl, substeps=substeps).step))


@pytest.fixture(scope="module")
def step():
    return compiled_step("c", 20)


@pytest.fixture(scope="module")
def start(reach):
    """`BATCH` fresh episodes."""
    return jax.jit(jax.vmap(reach.reset))(jax.random.split(jax.random.key(0), BATCH))


@pytest.fixture(scope="module")
def joints(reach, reference):
    """For each of our joints, its place in the reference's qpos."""
    theirs = reference.unwrapped.model
    names = [mujoco.mj_id2name(reach.model, mujoco.mjtObj.mjOBJ_JOINT, i) for i in range(reach.model.njnt)]
    return np.array([theirs.joint("robot0:" + _NAMES.get(name, f"{name}_joint")).qposadr[0] for name in names])


def gripper(reference):
    return reference.unwrapped.data.site("robot0:grip").xpos.copy()


@pytest.fixture(scope="module")
def transitions(reference):
    """Random moves all over the workspace, down to the table: (qpos, qvel, action, gripper before, gripper after)."""
    rng, rows = np.random.default_rng(0), []
    data, start = reference.unwrapped.data, reference.unwrapped.initial_gripper_xpos
    for episode in range(EPISODES):
        reference.reset(seed=episode)
        for time in range(48):
            if time % 6 == 0:
                target = start + rng.uniform(-0.15, 0.15, 3)
            pull = 10 * (target - gripper(reference)) * rng.uniform()
            action = np.clip(np.append(pull, 0) + rng.uniform(-0.7, 0.7, 4), -1, 1).astype(np.float32)
            before = (data.qpos.copy(), data.qvel.copy(), action, gripper(reference))
            reference.step(action)
            rows.append((*before, gripper(reference)))
    assert len(rows) == PARTS * BATCH
    return [np.stack(column) for column in zip(*rows, strict=True)]


def put(reach, state, joints, qpos, qvel):
    """Returns `state`, a batch, with the reference's joint positions and velocities."""
    physics = jax.jit(jax.vmap(reach.place))(qpos[:, joints].astype(np.float32), qvel[:, joints].astype(np.float32))
    return state.replace(pipeline_state=physics)


# MJX leaves out how the weld's Jacobian changes in time, hence its wider bounds.
@pytest.mark.parametrize(
    ("impl", "median_mm", "percentile_mm"), [("c", 0.2, 0.4), pytest.param("jax", 0.5, 1.5, marks=pytest.mark.slow)]
)
def test_one_step_displacement(reach, start, joints, transitions, impl, median_mm, percentile_mm):
    step, errors = compiled_step(impl, 20), []
    for part in range(PARTS):
        qpos, qvel, action, before, after = (column[part * BATCH : (part + 1) * BATCH] for column in transitions)
        state = put(reach, start, joints, qpos, qvel)
        np.testing.assert_allclose(state.pipeline_state.gripper_position, before, atol=1e-4)
        ours = np.asarray(step(state, action).info["achieved_goal"])
        errors.append(np.linalg.norm((ours - before) - (after - before), axis=-1))
    median, percentile = 1000 * np.percentile(np.concatenate(errors), [50, 99])
    print(f"one step on {impl}: median {median:.3f} mm, 99th percentile {percentile:.3f} mm")
    assert median <= median_mm
    assert percentile <= percentile_mm


@pytest.fixture(scope="module")
def open_loop(reference):
    """Fifty random actions for each of a batch, smooth ones so that the gripper travels; and where they end."""
    rng = np.random.default_rng(1)
    actions = np.repeat(rng.uniform(-1, 1, (10, BATCH, 4)), 5, axis=0).astype(np.float32)
    ends = []
    for episode in range(BATCH):
        reference.reset(seed=episode)
        for action in actions[:, episode]:
            reference.step(action)
        ends.append(gripper(reference))
    return actions, np.stack(ends)


@pytest.mark.parametrize(
    ("impl", "substeps", "bound_mm"),
    [("c", 20, 10.0), ("c", 4, 20.0), pytest.param("jax", 20, 20.0, marks=pytest.mark.slow)],
)
def test_open_loop_drift(open_loop, start, impl, substeps, bound_mm):
    """From the reset pose without feedback; an arm that is stretched out soon goes a way of its own."""
    step, (actions, ends), state = compiled_step(impl, substeps), open_loop, start
    for action in actions:
        state = step(state, action)
    drift = 1000 * np.linalg.norm(np.asarray(state.info["achieved_goal"]) - ends, axis=-1)
    print(f"50 steps open loop on {impl}, {substeps} substeps: median {np.median(drift):.1f} mm")
    assert np.median(drift) <= bound_mm


def test_rest_pose_and_reset(reference, reach, start, joints):
    unwrapped = reference.unwrapped
    np.testing.assert_allclose(reach.initial_gripper_position, unwrapped.initial_gripper_xpos, atol=5e-4)
    np.testing.assert_allclose(np.asarray(start.pipeline_state.qpos[0]), unwrapped.initial_qpos[joints], atol=5e-3)
    observation, _ = reference.reset(seed=0)
    np.testing.assert_allclose(start.info["features"][0, :3], observation["observation"][:3], atol=5e-4)
    np.testing.assert_allclose(start.info["features"][0, 3:], observation["observation"][5:8], atol=5e-4)


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
    state, action = start, np.tile(np.float32([0.5, -1.0, 0.3, 0.0]), (BATCH, 1))
    for _ in range(4):
        state = step(state, action)
        observation = reference.step(action[0])[0]["observation"]
    np.testing.assert_allclose(state.info["features"][0, 3:], observation[5:8], atol=5e-4)
    assert pytest.approx(reference.unwrapped.dt) == CONTROL_PERIOD


def test_the_table_holds(reference, reach, step, start):
    """Pushed down for long, the gripper rests on the table at the reference's height."""
    reference.reset(seed=0)
    state, action = start, np.tile(np.float32([0.0, 0.0, -1.0, 0.0]), (BATCH, 1))
    for _ in range(12):
        state = step(state, action)
        reference.step(action[0])
    assert float(state.info["achieved_goal"][0, 2]) == pytest.approx(gripper(reference)[2], abs=2e-3)

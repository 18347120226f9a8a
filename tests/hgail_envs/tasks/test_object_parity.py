"""Push, pick and place and slide on C MuJoCo against Gymnasium-Robotics' tasks."""

import jax
import mujoco
import numpy as np
import pytest
from scipy.stats import ks_2samp

import hgail_envs
from experiments.parity import joint_indices, make_counterpart
from hgail_envs.tasks.layouts import official

TASKS = ("push", "pick-and-place", "slide")
RESETS, REFERENCE_RESETS = 8000, 1000  # ours are cheaper; together as telling as 1,800 of each
EPISODES, STEPS = 8, 32


@pytest.fixture(scope="module", params=TASKS)
def env(request):
    return hgail_envs.make(request.param, impl="c", observation="official")


@pytest.fixture(scope="module")
def reference(env):
    return make_counterpart(env)


@pytest.fixture(scope="module")
def placed(env, reference):
    """Puts states of the reference, `[N, ...]` of its joints, into our task."""
    of_qpos, of_qvel = joint_indices(env.model, reference.model)
    place = jax.jit(jax.vmap(env.place))
    return lambda qpos, qvel: place(np.float32(qpos[:, of_qpos]), np.float32(qvel[:, of_qvel]))


def scripted(env, observation, step, episode):
    """A hand that comes to the object from above and grasps and lifts it, or from behind and pushes it on."""
    gripper, thing = observation[:3], observation[3:6]
    if env.model.nu:
        wanted, hand = thing + np.array([0, 0, 0.1 if step < 8 else 0.0]), (1.0 if step < 16 else -1.0)
        move = 10 * (wanted - gripper) if step < 20 else [0.3 * (-1) ** episode, 0.3, 0.7]
        return np.append(np.clip(move, -1, 1), hand)
    angle = 0.8 * episode
    direction = np.array([np.cos(angle), np.sin(angle)])
    if step < 14:
        wanted = np.append(thing[:2] - 0.08 * direction, 0.5 if step < 8 else 0.42)
        return np.append(np.clip(20 * (wanted - gripper), -1, 1), 0.0)
    speed = (0.4, 1.0)[episode % 2] if step < 26 else 0.0
    return np.array([*(speed * direction), np.clip(20 * (0.42 - gripper[2]), -1, 1), 0.0])


@pytest.fixture(scope="module")
def transitions(env, reference):
    """Columns: qpos, qvel, action, observation before, observation after; half random, half scripted."""
    rng, rows = np.random.default_rng(0), []
    for episode in range(EPISODES):
        observation = reference.reset(seed=episode)[0]["observation"]
        for step in range(STEPS):
            pull = np.append(10 * (observation[3:6] - observation[:3]) * rng.uniform(), 0.0)
            noise = np.clip(pull + rng.uniform(-1, 1, 4), -1, 1)
            action = np.float32(noise if episode % 2 else scripted(env, observation, step, episode // 2))
            mujoco.mj_forward(reference.model, reference.data)
            before = reference._get_obs()["observation"]
            state = reference.data.qpos.copy(), reference.data.qvel.copy()
            observation = reference.step(action)[0]["observation"]
            mujoco.mj_forward(reference.model, reference.data)
            rows.append((*state, action, before, reference._get_obs()["observation"]))
    return [np.stack(column) for column in zip(*rows, strict=True)]


def official_features(env):
    return lambda physics: official(env.object_title).join(env.official_features(physics))


def test_the_official_observation_is_the_reference_s(env, placed, transitions):
    qpos, qvel, _, before, _ = transitions
    ours = np.asarray(jax.jit(jax.vmap(official_features(env)))(placed(qpos, qvel)))
    assert np.abs(before[:, 11:20]).max(axis=0).min() > 0.01  # the object has turned about each axis, and moved
    np.testing.assert_allclose(ours, before, atol=2e-4)


def test_one_step_displacements(env, placed, transitions):
    """On the table, whose edges only slide's has."""
    qpos, qvel, action, before, after = transitions
    physics = placed(qpos, qvel)
    following = jax.jit(jax.vmap(env.step_physics))(physics, action)
    see = jax.jit(jax.vmap(official_features(env)))
    errors = 1000 * ((np.asarray(see(following)) - np.asarray(see(physics))) - (after - before))
    on_table = (before[:, 5] > 0.41) & (after[:, 5] > 0.41)
    is_scripted = np.repeat(np.arange(EPISODES) % 2 == 0, STEPS)
    moves = 1000 * np.linalg.norm((after - before)[:, 3:6], axis=1) > 1.0
    for name, chosen in (("scripted", is_scripted & on_table), ("random", ~is_scripted & on_table)):
        gripper, thing = (np.linalg.norm(errors[:, columns], axis=1) for columns in (slice(0, 3), slice(3, 6)))
        moved = thing[chosen & moves]
        print(
            f"{env.reference} {name}, {chosen.sum()} steps: gripper {np.median(gripper[chosen]):.3f} mm, 95 %"
            f" {np.percentile(gripper[chosen], 95):.3f}; object in {len(moved)} steps that move it"
            f" {np.median(moved):.3f} mm, 95 % {np.percentile(moved, 95):.3f}"
        )
        assert np.median(gripper[chosen]) <= 0.02
        assert np.percentile(thing[chosen], 95) <= 5.0
        assert len(moved) > 10
        assert np.median(moved) <= 0.3


def test_starts_and_goals_are_distributed_as_the_reference_s(env, reference):
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), RESETS))
    ours = np.concatenate(
        [state.pipeline_state.qpos[:, env.qpos_of(env.object_name)], state.info["desired_goal"][:, :3]], axis=1
    )
    theirs = []
    for seed in range(REFERENCE_RESETS):
        seen = reference.reset(seed=seed)[0]
        theirs.append(np.concatenate([seen["achieved_goal"], seen["desired_goal"]]))
    for column, (one, other) in enumerate(zip(ours.T, np.transpose(theirs), strict=True)):
        p = ks_2samp(np.round(one.astype(float), 3), np.round(other, 3)).pvalue  # heights are equal to 1e-6
        print(f"{env.reference} {('object', 'goal')[column // 3]} {'xyz'[column % 3]}: p = {p:.3f}")
        assert p > 0.001


def test_the_arm_starts_as_the_reference_s(env, reference):
    seen = reference.reset(seed=0)[0]["observation"]
    state = jax.jit(env.reset)(jax.random.key(0))
    np.testing.assert_allclose(env.initial_gripper_position, reference.initial_gripper_xpos, atol=1e-3)
    np.testing.assert_allclose(state.info["features"][:3], seen[:3], atol=1e-3)
    np.testing.assert_allclose(state.info["features"][9:11], seen[9:11], atol=1e-4)
    np.testing.assert_allclose(env.object_height, reference.height_offset, atol=1e-5)

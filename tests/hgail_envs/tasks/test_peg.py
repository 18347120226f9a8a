"""The peg and the hole of the page on own tasks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hgail_envs
from hgail_envs.tasks.objects import gripper_goal, is_object
from tests.support import own_tasks

ABOVE = 0.06  # metres over its place, at which the script carries the peg


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    with own_tasks(tmp_path_factory.mktemp("own")):
        yield hgail_envs.make("peg:Peg", substeps=8)


@pytest.fixture(scope="module")
def hole(env):
    return np.asarray(env.sample_goal(jax.random.key(0), env.reset_physics(jax.random.key(0)))[:3])


def dropped(env, place):
    """Returns the physics a second after the peg was let go at a place, `[3]`, while the arm stands still."""
    physics = env.put_down(env.reset_physics(jax.random.key(0)), "peg", jnp.asarray(place, jnp.float32))
    step = jax.jit(lambda physics: env.step_physics(physics, jnp.zeros(4)))
    for _ in range(25):
        physics = step(physics)
    return physics


@pytest.mark.parametrize(
    ("aside", "is_in"),
    [
        ((0.0, 0.0, 0.002), True),
        ((0.004, -0.004, 0.002), True),
        ((0.01, 0.01, 0.042), False),  # on the block's edge
        ((0.02, 0.0, 0.042), False),  # leans in the hole
        ((0.0, 0.1, 0.002), False),
    ],
)
def test_a_peg_that_stands_in_the_hole_is_there_and_no_other(env, hole, aside, is_in):
    physics = dropped(env, hole + np.array(aside))
    assert env.reached(physics, jnp.append(hole, 1.0)) == is_in
    stands = np.abs(physics.qpos[env.qpos_of("peg").stop :][:4]).max() > 0.999
    low = abs(float(env.object_position(physics)[2]) - hole[2]) < 2e-3
    assert (stands and low) == (is_in or aside[1] == 0.1)


def test_the_stages_of_a_relay_lead_into_the_hole_from_above(env, hole):
    physics = env.reset_physics(jax.random.key(0))
    plan = env.plan_goals(jax.random.key(0), physics, False).replace(relay=jnp.array(True))
    peg = env.object_position(physics)
    np.testing.assert_allclose(env.current_goal(plan, physics, 0), gripper_goal(peg))
    for aside, height in ((0.1, hole[2] + ABOVE), (0.005, hole[2])):
        held = env.put_down(physics, "peg", jnp.array([hole[0] + aside, hole[1], 0.5]))
        held = held.replace(gripper_position=env.object_position(held))
        goal = env.current_goal(plan, held, 0)
        np.testing.assert_allclose(goal, [*hole[:2], height, 1.0], atol=1e-6)
        assert is_object(goal)


def test_some_training_episodes_begin_with_the_peg_in_the_hand_and_no_others_do(env):
    physics, keys = env.reset_physics(jax.random.key(0)), jax.random.split(jax.random.key(0), 64)
    started = jax.vmap(lambda rng: env.training_start(rng, physics, True))(keys)
    in_hand = np.flatnonzero(started.object_start[:, 2] > 0.5)
    assert 8 <= len(in_hand) <= 24
    held = jax.tree.map(lambda leaf: leaf[in_hand[0]], started)
    step = jax.jit(env.step_physics)
    for _ in range(10):
        held = step(held, jnp.array([0.0, 0.0, 0.0, -1.0]))
    assert env.holding(held)
    np.testing.assert_allclose(env.object_position(held), held.object_start, atol=0.01)
    others = jax.vmap(lambda rng: env.training_start(rng, physics, False))(keys)
    np.testing.assert_array_equal(others.qpos, jnp.broadcast_to(physics.qpos, others.qpos.shape))


def test_a_script_puts_the_peg_into_the_hole(env, hole):
    layout = env.features_layout + env.goal_layout

    def act(observation):
        seen = layout.split(observation)
        apart, held = seen["peg position less gripper position"], seen["hand holds the peg"] > 0.5
        way = hole - seen["peg position"]
        aside = jnp.linalg.norm(jnp.where(held, way, apart)[:2]) > 0.01
        move = jnp.where(held, way, apart) + jnp.where(aside, jnp.array([0.0, 0.0, ABOVE]), 0.0)
        close = held | (jnp.linalg.norm(apart) < 0.015)
        return jnp.append(jnp.clip(20.0 * move, -1.0, 1.0), jnp.where(close, -1.0, 1.0))

    step, state = jax.jit(jax.vmap(env.step)), jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 16))
    script = jax.jit(jax.vmap(act))
    for _ in range(env.episode_length):
        state = step(state, script(state.obs))
    goals = jnp.broadcast_to(jnp.append(hole, 1.0), (16, 4))
    assert jax.vmap(env.reached)(state.pipeline_state, goals).sum() >= 12

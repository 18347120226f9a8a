"""Which numbers a policy with pictures observes, and what its observation shows."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hgail_envs
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.pictures import Pictures

pytestmark = pytest.mark.usefixtures("rendering")


@functools.cache
def made(task, target):
    env = hgail_envs.make(task)
    return CameraEnv(env, Pictures(env, ["front"], 16, target=target))


@functools.cache
def started(task, target):
    return jax.jit(made(task, target).reset)(jax.random.key(0))


def known(task, target):
    return np.asarray(started(task, target).obs)[made(task, target).known]


@pytest.mark.parametrize("task", [pytest.param("reach", marks=pytest.mark.slow), "push", "grasp"])
def test_the_goal_is_given_unless_it_is_seen(task):
    goal = np.asarray(started(task, "given").info["desired_goal"])
    own = known(task, "given")[: -len(goal)]
    np.testing.assert_array_equal(known(task, "given")[-len(goal) :], goal)
    np.testing.assert_array_equal(known(task, "seen"), own)
    assert len(own) and not np.isin(goal[:2], own).any()


def test_the_positions_of_cube_and_marker_are_in_the_observation():
    env, state = made("push", "seen"), started("push", "seen")
    expected = np.concatenate([state.info["features"][env.task.features_layout["cube position"]], _goal(state)])
    np.testing.assert_allclose(state.obs[env.objects], expected, atol=1e-6)
    np.testing.assert_array_equal(made("push", "given").objects, env.objects[:3])


def test_the_look_follows_from_the_key_of_the_reset():
    keys = jnp.stack([jax.random.key(seed) for seed in (0, 0, 1)])
    one, again, other = np.asarray(jax.jit(jax.vmap(made("push", "given").reset))(keys).info["look"])
    np.testing.assert_array_equal(one, again)
    assert (one != other).all()


def test_things_have_no_place_among_the_objects():
    task = hgail_envs.make("push")
    env = CameraEnv(task, Pictures(task, ["front"], 16, look="things", target="seen"))
    np.testing.assert_array_equal(env.objects, made("push", "seen").objects)
    state = jax.jit(env.reset)(jax.random.key(0))
    assert state.obs.shape == (env.observation_size,) and env.see(state.obs).shape == (1, 16, 16, 3)


@pytest.mark.parametrize("where", ["reset", "step", "move_target"])
def test_the_marker_is_at_the_goal_of_the_state(where):
    env, state = made("push", "seen"), started("push", "seen")
    if where == "step":
        state = jax.jit(env.step)(state, jnp.ones(4))
    elif where == "move_target":
        state = jax.jit(env.move_target)(state, jnp.array([1.3, 0.7, 0.5]))
    np.testing.assert_array_equal(state.obs[env.objects[-3:]], _goal(state))
    shown = env.pictures(jnp.concatenate([state.pipeline_state.qpos, _goal(state)]), state.info["look"])
    np.testing.assert_array_equal(env.see(state.obs), shown)


def test_a_late_picture_shows_the_state_before_the_action():
    env = hgail_envs.make("push")
    late = CameraEnv(env, Pictures(env, ["front"], 16, look="late"))
    start = jax.jit(jax.vmap(late.reset))(jax.random.split(jax.random.key(0), 32))
    fraction = start.info["late"].mean()
    assert 0.2 < fraction < 0.8
    step = jax.jit(jax.vmap(late.step))
    after = step(start, jnp.ones((32, 4)))
    again = step(after, jnp.ones((32, 4)))
    own = np.s_[:, : env.observation_size]
    positions = np.s_[:, env.observation_size : env.observation_size + env.model.nq]
    for before, now in ((start, after), (after, again)):
        one, other = before.pipeline_state.qpos, now.pipeline_state.qpos
        expected = np.where(start.info["late"][:, None], one, other)
        np.testing.assert_array_equal(now.obs[positions], expected)
        np.testing.assert_array_equal(now.obs[own], jax.vmap(env.goal_observation)(*_parts(now)))


def _parts(state):
    return state.info["features"], state.info["desired_goal"]


def _goal(state):
    return state.info["desired_goal"][:3]

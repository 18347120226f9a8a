"""What all Fetch tasks share, on C MuJoCo."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import hgail_envs
from hgail_envs.robots.base import TOP_SPEED
from hgail_envs.tasks.base import CONTROL_PERIOD, FAST_SUBSTEPS, REFERENCE_SUBSTEPS

FEW_TASKS = [pytest.param("reach", marks=pytest.mark.slow), "grasp"]
"""Grasp has what reach has, and a cube and a hand."""


@pytest.mark.parametrize("task", FEW_TASKS)
def test_random_steps_stay_within_bounds(task):
    env = hgail_envs.make(task, substeps=FAST_SUBSTEPS)

    def step(state, rng):
        action = jax.random.uniform(rng, (32, 4), minval=-1.5, maxval=1.5)
        state = jax.vmap(env.step)(state, action)
        return state, (abs(state.obs) < env.observation_limit).all()

    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 32))
    scan = jax.jit(lambda state, rngs: jax.lax.scan(step, state, rngs)[1])
    assert scan(state, jax.random.split(jax.random.key(1), 200)).all()


@pytest.mark.parametrize("impl", ["c", "jax"])
def test_accurate_physics_is_the_default_and_can_be_asked_for(impl):
    assert hgail_envs.make("reach", impl=impl).substeps == REFERENCE_SUBSTEPS == 20
    fast = hgail_envs.make("reach", impl=impl, substeps=4)
    accurate = fast.reference_physics()
    assert (fast.substeps, accurate.substeps) == (4, 20)
    assert (fast.impl, accurate.impl) == (impl, impl)
    assert (fast.engine.model.opt.timestep, accurate.engine.model.opt.timestep) == (0.01, 0.002)


def test_accurate_physics_is_that_of_a_task_made_with_it():
    fast, made = hgail_envs.make("reach", substeps=4), hgail_envs.make("reach")
    state, action = jax.jit(made.reset)(jax.random.key(0)), np.array([1.0, -0.5, 0.2, 1.0])
    ends = [jax.jit(env.step)(state, action).obs for env in (fast.reference_physics(), made, fast)]
    np.testing.assert_array_equal(ends[0], ends[1])
    assert np.abs(ends[0] - ends[2]).max() > 1e-4


@functools.cache
def stepped(task):
    """A task, a start and the program of a step."""
    env = hgail_envs.make(task)
    return env, jax.jit(env.reset)(jax.random.key(1)), jax.jit(env.step)


def test_what_is_seen_of_the_gripper_is_where_mujoco_has_it():
    """Position, and velocity times the period, after some actions, against C MuJoCo's kinematics of the joints."""
    env, state, step = stepped("grasp")
    data, velocity = mujoco.MjData(env.model), np.zeros(6)
    for action in np.random.default_rng(0).uniform(-1, 1, (5, 4)):
        state = step(state, action)
        data.qpos[:], data.qvel[:] = state.pipeline_state.qpos, state.pipeline_state.qvel
        mujoco.mj_forward(env.model, data)
        site = env.model.site("grip").id
        mujoco.mj_objectVelocity(env.model, data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 0)
        np.testing.assert_allclose(state.obs[:3], data.site_xpos[site], atol=1e-5)
        np.testing.assert_allclose(state.obs[3:6], CONTROL_PERIOD * velocity[3:], atol=1e-5)
    assert state.info["step"] == 5


@pytest.mark.parametrize("task", FEW_TASKS)
def test_a_simulation_that_broke_down_does_not_come_back(task):
    """C MuJoCo would start it anew, and the episode would continue as if nothing had happened."""
    _, state, step = stepped(task)
    physics = state.pipeline_state
    state = state.replace(pipeline_state=physics.replace(qvel=physics.qvel.at[5].set(1e12)))
    for _ in range(3):
        state = step(state, np.zeros(4))
        assert np.isnan(state.obs[:3]).any()


def test_its_engine_is_prepared(monkeypatch):
    env, prepared = hgail_envs.make("reach", impl="c", substeps=4), []
    monkeypatch.setattr(env.engine, "prepare", lambda: prepared.append("engine"))
    env.prepare()
    assert prepared == ["engine"]


def test_the_fetch_s_lowest_height_and_top_speed_are_those_of_its_physics():
    env = hgail_envs.make("reach", impl="c")
    state = jax.jit(env.reset)(jax.random.key(0))

    @jax.jit
    def places(*move):
        action = jnp.array([*move, 0.0])
        states = jax.lax.scan(lambda s, _: (env.step(s, action),) * 2, state, length=20)[1]
        return states.pipeline_state.gripper_position

    # Pressed into the table, the pads sink two millimetres.
    assert places(0.0, 0.0, -1.0)[-1, 2] == pytest.approx(env.robot.lowest_height, abs=3e-3)
    moved = np.diff(places(0.0, -1.0, 0.3)[4:10, 1])
    np.testing.assert_allclose(-moved / CONTROL_PERIOD, TOP_SPEED, rtol=0.1)

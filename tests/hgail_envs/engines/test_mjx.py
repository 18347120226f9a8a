"""MJX-JAX: its precision, its buffers, and that one can train on it. Its physics is compared in `test_reach_parity`."""

import ctypes

import jax
import mujoco
import numpy as np
import pytest
from mujoco import mjx

import hgail_envs
from hgail_envs.engines.mjx import buffer_sizes
from hgail_envs.robots.fetch import Fetch
from hgail_jax import Hyperparameters, phase_table
from hgail_jax.seeds import compile_train_step, init_seeds, seed_keys
from tests.support import TINY


@pytest.mark.parametrize("task", ["reach", pytest.param("grasp", marks=pytest.mark.slow)])
def test_no_product_of_the_physics_is_left_to_a_gpu_s_default_precision_and_mjx_may_promote_where_others_may_not(task):
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        env = hgail_envs.make(task, impl="jax")
        state = jax.eval_shape(env.reset, jax.random.key(0))
        program = str(jax.make_jaxpr(env.step)(state, jax.ShapeDtypeStruct((4,), np.float32)))
    assert program.count("precision=(Precision.HIGH") == program.count("dot_general[") > 100


def test_buffers_hold_what_mjx_jax_allots():
    """MJX-JAX has a row for whatever could be in contact, with four points for a pair of boxes instead of eight."""
    for task in ("reach", "grasp", "push", "stack", "tower"):
        env = hgail_envs.make(task, impl="jax")
        sizes = buffer_sizes(Fetch(task).model, worlds=3)
        physics = jax.eval_shape(env.reset, jax.random.key(0)).pipeline_state
        data = jax.eval_shape(lambda one, env=env: env.engine.data(one, env.control(one, np.zeros(3))), physics)
        assert sizes["njmax"] >= data._impl.efc_J.shape[0]
        assert sizes["naconmax"] % 3 == 0


def test_blank_data_of_warp_has_no_number_that_was_in_memory_before(monkeypatch):
    """Such numbers would be constants of a program, which the next process would not find in the cache."""
    pytest.importorskip("warp")
    context = pytest.importorskip("warp._src.context")
    allocate, before = context.CpuDefaultAllocator.allocate, [0]

    def allocate_used(self, size):
        address = allocate(self, size)
        before[0] += size
        ctypes.memset(address, before[1], size)
        return address

    monkeypatch.setattr(context.CpuDefaultAllocator, "allocate", allocate_used)
    model = Fetch("push").model

    def make(byte):
        before[:] = 0, byte
        data = jax.device_get(mjx.make_data(model, impl="warp", **buffer_sizes(model, worlds=3)))
        assert before[0] > 1000
        return data

    jax.tree.map(np.testing.assert_array_equal, make(0x11), make(0x77))


def test_buffers_have_a_row_for_each_joint_with_friction():
    body = '<body pos="{0} 0 0"><joint frictionloss="1"/><geom size=".1"/></body>'
    bodies = "".join(body.format(place) for place in range(3))
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert buffer_sizes(model, worlds=1)["njmax"] == data.nefc == 3


@pytest.mark.slow
def test_a_tiny_training_runs():
    env = hgail_envs.make("reach", impl="jax", substeps=4)
    config = TINY.replace(rounds=1)
    states = init_seeds(env, config, Hyperparameters(), seed_keys(0, 2))
    before = jax.tree.map(np.asarray, states.learner.actor_critic)
    phases = phase_table(config)
    step = compile_train_step(env, config, states, phases[0])
    for row in phases:
        states, metrics = step(states, row)
    del metrics.update["bc_loss"]  # which this method does not measure
    assert all(np.isfinite(values).all() for values in jax.tree.leaves((metrics, states.learner.actor_critic)))
    assert not any(map(np.array_equal, jax.tree.leaves(before), jax.tree.leaves(states.learner.actor_critic)))
    for share in (metrics.dropped, metrics.overflow, metrics.diverged):
        np.testing.assert_array_equal(share, 0.0)

"""Two GPUs of one host that share a seed must hold the same numbers, which only their programs keep so."""

import jax
import numpy as np
import pytest

import hgail_envs
from hgail_jax import PPO, Config, Hyperparameters, phase_table
from hgail_jax.devices.sharding import make_mesh, shard
from hgail_jax.seeds import compile_train_step, init_seeds, seed_keys

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(jax.default_backend() != "gpu" or jax.device_count() < 2, reason="needs two GPUs"),
]


def test_gpus_that_share_a_seed_hold_the_same_bits_after_a_training():
    config = Config(PPO(), num_envs=256, rounds=4)
    mesh = make_mesh(1, config.num_envs, jax.devices()[:2])
    env = hgail_envs.make("reach", substeps=4, worlds=config.num_envs // 2)
    env.prepare()
    states = init_seeds(env, config, Hyperparameters(), seed_keys(0, 1))
    step = compile_train_step(env, config, states, phase_table(config)[0], mesh)
    states = shard(states, mesh)
    for phases in phase_table(config):
        states, metrics = step(states, phases)
    print(f"success after {config.rounds} rounds: {float(metrics.evaluation.success[0]):.3f}")
    leaves = jax.tree.leaves(states.replace(rng=jax.random.key_data(states.rng)))
    assert leaves
    for leaf in leaves:
        first, second = (np.asarray(part.data) for part in leaf.addressable_shards)
        assert first.shape == leaf.shape  # each GPU has all of it
        np.testing.assert_array_equal(first, second)
    assert metrics.evaluation.success[0] > 0.9

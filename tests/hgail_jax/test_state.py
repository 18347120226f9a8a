import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from hgail_jax import Config, Hyperparameters, init_state
from hgail_jax.networks import apply, discriminator_network, policy_network, value_network
from hgail_jax.samples import Samples

ENV, CONFIG = envs.make("point"), Config()
LIVELY = 0.5  # added to all weights: the last layer of a new policy is next to zero


def samples(seed, scale, shift):
    rng = np.random.default_rng(seed)
    observation = rng.normal(shift, scale, (200, 6))
    observation[:, 2] = 0.5  # a number that never varies
    action = rng.normal(size=(200, 3))
    return Samples(*(jnp.asarray(array, jnp.float32) for array in (observation, action, np.ones(200))))


def outputs(state, probe):
    observation = state.normalize(probe.observation)
    inputs = jnp.concatenate([observation, probe.action], axis=-1)
    networks = [
        (policy_network(CONFIG, 3), state.actor_critic["policy"], observation),
        (value_network(CONFIG), state.actor_critic["value"], observation),
        (discriminator_network(CONFIG), state.discriminator, inputs),
    ]
    return [apply(*network) for network in networks]


@pytest.fixture
def state():
    state = init_state(ENV, CONFIG, Hyperparameters(), jax.random.key(0)).observe(samples(0, 0.05, 0.0))
    networks = {"actor_critic": state.actor_critic, "discriminator": state.discriminator}
    return state.replace(
        **jax.tree.map(lambda leaf: leaf + LIVELY * jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape), networks)
    )


def test_networks_keep_their_function_when_the_statistics_move(state):
    after, probe = state.observe(samples(1, 0.2, 0.1), samples(2, 0.1, -0.1)), samples(3, 0.05, 0.0)
    assert (np.abs(after.statistics.std / state.statistics.std - 1.0) > 0.5)[[0, 1, 3, 4, 5]].all()
    for before, now in zip(outputs(state, probe), outputs(after, probe), strict=True):
        assert np.std(before) > 0.05
        np.testing.assert_allclose(now, before, atol=1e-4)


def test_the_first_samples_set_the_scale():
    fresh = init_state(ENV, CONFIG, Hyperparameters(), jax.random.key(0))
    first = samples(0, 0.05, 3.0)
    state = fresh.observe(first)
    jax.tree.map(np.testing.assert_array_equal, state.actor_critic, fresh.actor_critic)
    normalized = np.delete(np.asarray(state.normalize(first.observation)), 2, axis=1)
    np.testing.assert_allclose(normalized.std(0), 1.0, rtol=1e-3)
    np.testing.assert_allclose(normalized.mean(0), 0.0, atol=1e-3)


def test_a_number_that_begins_to_vary_does_not_blow_up(state):
    late = samples(1, 0.05, 0.0)
    late = late.replace(observation=late.observation.at[:20, 2].add(1.0))
    after = state.observe(late)
    before, now = state.actor_critic["policy"], after.actor_critic["policy"]
    np.testing.assert_array_equal(now["params"]["Dense_0"]["kernel"][2], before["params"]["Dense_0"]["kernel"][2])
    assert all(np.isfinite(output).all() for output in outputs(after, late))


def test_samples_without_weight_do_not_count(state):
    part = samples(1, 0.2, 0.1)
    half = part.replace(weight=part.weight.at[100:].set(0.0))
    first = jax.tree.map(lambda leaf: leaf[:100], part)
    expected, found = state.observe(first).statistics, state.observe(half).statistics
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-5)
    np.testing.assert_allclose(found.std, expected.std, rtol=1e-5)

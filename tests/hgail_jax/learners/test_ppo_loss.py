import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from hgail_jax.learners.ppo_loss import generalized_advantages, policy_loss, standardize
from hgail_jax.networks import gaussian_log_prob

RNG = np.random.default_rng(0)
LENGTH, EPISODES = 7, 3
REWARD = RNG.normal(size=(LENGTH, EPISODES)).astype(np.float32)
VALUE = RNG.normal(size=(LENGTH + 1, EPISODES)).astype(np.float32)


@pytest.mark.parametrize(("discount", "gae_lambda"), [(0.98, 0.95), (0.9, 0.0), (1.0, 1.0), (0.0, 0.5)])
def test_advantages_agree_with_a_double_sum(discount, gae_lambda):
    expected = np.zeros_like(REWARD)
    for t in range(LENGTH):
        for k in range(t, LENGTH):
            delta = REWARD[k] + discount * VALUE[k + 1] - VALUE[k]
            expected[t] += (discount * gae_lambda) ** (k - t) * delta
    np.testing.assert_allclose(
        generalized_advantages(REWARD, VALUE, discount, gae_lambda), expected, rtol=1e-4, atol=1e-5
    )


def test_the_time_limit_is_a_truncation():
    """With λ = 1 the return is the rewards plus the value of the state in which the episode was cut off."""
    returns = np.asarray(generalized_advantages(REWARD, VALUE, 0.9, 1.0)) + VALUE[:-1]
    expected = VALUE[-1]
    for reward in REWARD[::-1]:
        expected = reward + 0.9 * expected
    np.testing.assert_allclose(returns[0], expected, rtol=1e-4)
    of_a_terminal = np.asarray(generalized_advantages(REWARD, np.concatenate([VALUE[:-1], 0 * VALUE[:1]]), 0.9, 1.0))
    assert not np.allclose(returns[0], of_a_terminal[0] + VALUE[0])


def test_policy_loss_by_hand():
    old = jnp.log(jnp.array([0.5, 0.5, 0.5, 0.5]))
    new = jnp.log(jnp.array([0.5, 1.0, 0.55, 0.1]))  # ratios 1, 2, 1.1, 0.2
    advantage = jnp.array([1.0, 1.0, -1.0, -1.0])
    loss, metrics = policy_loss(new, old, advantage, jnp.ones(4), 0.2)
    assert loss == pytest.approx(-(1.0 + 1.2 - 1.1 - 0.8) / 4, rel=1e-5)
    assert metrics["clip_fraction"] == pytest.approx(0.5)
    ratio = np.array([1, 2, 1.1, 0.2])
    assert metrics["kl"] == pytest.approx(np.mean(ratio - 1 - np.log(ratio)), rel=1e-4)


def test_log_prob_is_the_normal_density():
    action, mean = RNG.normal(size=(5, 4)), RNG.normal(size=(5, 4))
    expected = norm.logpdf(action, mean, 0.3).sum(-1)
    np.testing.assert_allclose(gaussian_log_prob(jnp.asarray(action), jnp.asarray(mean), 0.3), expected, rtol=1e-4)


def test_standardize():
    values = np.asarray(standardize(jnp.asarray(REWARD), jnp.ones_like(REWARD)))
    assert values.mean() == pytest.approx(0, abs=1e-6)
    assert values.std() == pytest.approx(1, rel=1e-4)
    np.testing.assert_array_equal(standardize(jnp.full((4,), 3.0), jnp.ones(4)), 0.0)

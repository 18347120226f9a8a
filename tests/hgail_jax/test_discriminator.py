import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hgail_jax import TD3, Config
from hgail_jax.config import REWARDS
from hgail_jax.discriminator import (
    discriminate,
    discriminator_accuracy,
    discriminator_loss,
    gradient_penalty,
    imitation_reward,
    r1,
    r2,
    r3,
    r4,
)


def test_accuracy_is_the_share_of_logits_on_the_right_side_of_0():
    expert, policy = np.float32([0.5, 0.0, 2.0, -0.5]), np.float32([-0.5, 0.0, 0.5])
    assert discriminator_accuracy(expert, policy) == pytest.approx((2 / 4 + 2 / 3) / 2)
    assert discriminator_loss(expert, policy) == pytest.approx(
        np.logaddexp(0, -expert).mean() + np.logaddexp(0, policy).mean(), rel=1e-5
    )


def test_sign_expert_samples_are_pushed_up():
    slope_expert, slope_policy = jax.grad(discriminator_loss, argnums=(0, 1))(jnp.zeros(1), jnp.zeros(1))
    assert slope_expert < 0 < slope_policy


def test_the_gradient_penalty_is_of_slopes_between_the_samples():
    """Against central differences of the logit, at points a given share of the way."""
    config = Config(TD3(), discriminator_hidden=(9,))
    rng = np.random.default_rng(0)
    layers = {name: rng.normal(size=shape) for name, shape in (("a", (5, 9)), ("b", 9), ("c", (9, 1)), ("d", 1))}
    network = {
        "params": {
            "Dense_0": {"kernel": layers["a"], "bias": layers["b"]},
            "Dense_1": {"kernel": layers["c"], "bias": layers["d"]},
        }
    }
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), network)
    expert, policy = ((rng.uniform(-0.9, 0.9, (4, 3)), rng.uniform(-0.9, 0.9, (4, 2))) for _ in range(2))
    share = rng.uniform(size=(4, 1))
    mixed = np.concatenate(
        [share * one + (1 - share) * other for one, other in zip(expert, policy, strict=True)], axis=-1
    )

    def logit(inputs):
        return np.tanh(inputs @ layers["a"] + layers["b"]) @ layers["c"][:, 0] + layers["d"][0]

    np.testing.assert_allclose(discriminate(config, params, mixed[:, :3], mixed[:, 3:]), logit(mixed), rtol=1e-4)
    steps = 1e-5 * np.eye(5)
    slopes = np.stack([(logit(mixed + step) - logit(mixed - step)) / 2e-5 for step in steps], axis=-1)
    expected = np.mean((np.linalg.norm(slopes, axis=-1) - 1) ** 2)
    to_arrays = (jax.tree.map(jnp.float32, pair) for pair in (expert, policy))
    found = gradient_penalty(config, params, *to_arrays, jnp.float32(share))
    np.testing.assert_allclose(found, expected, rtol=1e-4)


# Rewards

LOGITS = np.linspace(-8, 8, 65, dtype=np.float32)


def sigmoid(x):
    return 1 / (1 + np.exp(-x.astype(np.float64)))


def test_r1_is_the_paper_s_form_and_softplus():
    np.testing.assert_allclose(r1(LOGITS), -np.log(1 - sigmoid(LOGITS)), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(r1(LOGITS), np.logaddexp(0, LOGITS), rtol=1e-5)


def test_r2_is_the_logarithm_of_the_clipped_logit():
    inside = np.array([0.1, 0.5, 1.0, 3.0], np.float32)
    np.testing.assert_allclose(r2(inside), np.log(np.minimum(inside, 1)), rtol=1e-5)
    assert np.isfinite(r2(LOGITS)).all()
    assert (r2(LOGITS) <= 0).all()


def test_r4_is_r3():
    np.testing.assert_allclose(r4(LOGITS), np.log(sigmoid(LOGITS)) - np.log(1 - sigmoid(LOGITS)), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(r4(LOGITS), r3(LOGITS), rtol=1e-5, atol=1e-6)


def test_all_forms_grow_with_the_logit():
    for form in REWARDS.values():
        rewards = np.asarray(imitation_reward(form, jnp.asarray(LOGITS)))
        assert (np.diff(rewards) >= -1e-6).all()
        assert rewards[-1] > rewards[0]


def test_forms_can_be_swept_in_one_program():
    forms = jnp.array(list(REWARDS.values()))
    swept = jax.vmap(imitation_reward, in_axes=(0, None))(forms, jnp.asarray(LOGITS))
    for form, rewards in zip(forms, swept, strict=True):
        np.testing.assert_allclose(rewards, (r1, r2, r3, r4)[int(form)](LOGITS), rtol=1e-6)

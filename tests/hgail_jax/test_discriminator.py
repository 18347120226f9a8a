import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from hgail_jax.config import Config
from hgail_jax.discriminator import discriminator_accuracy, discriminator_loss
from hgail_jax.networks import apply, discriminator_network


def test_learns_the_log_ratio_of_two_gaussians():
    """Expert samples are N(1, 1), the policy's N(-1, 1): at the optimum the logit is 2 x."""
    network, optimizer = discriminator_network(Config()), optax.adam(3e-3)
    params = network.init(jax.random.key(0), jnp.zeros(1))

    def step(carry, rng):
        params, state = carry
        expert = 1.0 + jax.random.normal(jax.random.fold_in(rng, 0), (256, 1))
        policy = -1.0 + jax.random.normal(jax.random.fold_in(rng, 1), (256, 1))

        def loss(params):
            return discriminator_loss(apply(network, params, expert)[:, 0], apply(network, params, policy)[:, 0])

        value, gradient = jax.value_and_grad(loss)(params)
        update, state = optimizer.update(gradient, state)
        return (optax.apply_updates(params, update), state), value

    rngs = jax.random.split(jax.random.key(1), 800)
    (params, _), losses = jax.jit(lambda carry: jax.lax.scan(step, carry, rngs))((params, optimizer.init(params)))
    x = np.linspace(-2, 2, 41)[:, None]
    np.testing.assert_allclose(apply(network, params, x)[:, 0], 2 * x[:, 0], atol=0.45)
    assert losses[-100:].mean() < losses[0]


def test_loss_and_accuracy_at_chance_and_when_certain():
    zeros = jnp.zeros(8)
    assert discriminator_loss(zeros, zeros) == pytest.approx(2 * np.log(2))
    assert discriminator_loss(zeros + 20, zeros - 20) == pytest.approx(0, abs=1e-6)
    assert discriminator_accuracy(zeros + 1, zeros - 1) == 1.0
    assert discriminator_accuracy(zeros - 1, zeros + 1) == 0.0


def test_sign_expert_samples_are_pushed_up():
    slope_expert, slope_policy = jax.grad(discriminator_loss, argnums=(0, 1))(jnp.zeros(1), jnp.zeros(1))
    assert slope_expert < 0 < slope_policy

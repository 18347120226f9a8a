"""The paper's four rewards, as functions of the discriminator's logit."""

import jax
import jax.numpy as jnp

R1, R2, R3, R4 = range(4)
_R2_FLOOR = 1e-3  # r2 takes a logarithm of a number that may be 0


def r1(logits: jax.Array) -> jax.Array:
    """-log(1 - σ(logit)), which is softplus(logit)."""
    return jax.nn.softplus(logits)


def r2(logits: jax.Array) -> jax.Array:
    """Log clip(logit, 0, 1), with a floor of 1e-3 under the logarithm."""
    return jnp.log(jnp.clip(logits, _R2_FLOOR, 1.0))


def r3(logits: jax.Array) -> jax.Array:
    """The logit itself."""
    return logits


def r4(logits: jax.Array) -> jax.Array:
    """Log σ(logit) - log(1 - σ(logit)), which is the logit again."""
    return jax.nn.log_sigmoid(logits) - jax.nn.log_sigmoid(-logits)


def imitation_reward(form: jax.Array | int, logits: jax.Array) -> jax.Array:
    """Returns the reward of logits, `[...]`, in the form `R1`, `R2`, `R3` or `R4`, which may be traced.

    The logit is high where a sample looks like an expert's (see `hgail_jax.discriminator`), and all four forms grow
    with it.
    """
    return jax.lax.switch(form, (r1, r2, r3, r4), logits)

"""The paper's four rewards, which its figure 7 compares, as functions of the discriminator's logit.

The logit is the paper's `dis`, read as the expert-like one: σ(logit) is the probability that a sample is an expert's,
and the paper's D, which its equations drive to 1 on the policy's samples, is 1 - σ(logit). See
`hgail_jax.discriminator`.
"""

import jax
import jax.numpy as jnp

R1, R2, R3, R4 = range(4)
_R2_FLOOR = 1e-3  # r2 takes a logarithm of a number that may be 0


def r1(logits: jax.Array) -> jax.Array:
    """-log(1 - σ(logit)), which is softplus(logit): never negative, the paper's default."""
    return jax.nn.softplus(logits)


def r2(logits: jax.Array) -> jax.Array:
    """Log clip(logit, 0, 1), with a floor of 1e-3 under the logarithm: flat where the logit is outside (0, 1)."""
    return jnp.log(jnp.clip(logits, _R2_FLOOR, 1.0))


def r3(logits: jax.Array) -> jax.Array:
    """The logit itself: log p_expert - log p_policy for the best discriminator."""
    return logits


def r4(logits: jax.Array) -> jax.Array:
    """Log σ(logit) - log(1 - σ(logit)): by algebra the logit again, so that r4 and r3 differ by rounding alone."""
    return jax.nn.log_sigmoid(logits) - jax.nn.log_sigmoid(-logits)


def imitation_reward(form: jax.Array | int, logits: jax.Array) -> jax.Array:
    """Returns the reward of logits, `[...]`, in the form `R1`, `R2`, `R3` or `R4`, which may be traced.

    The logit is high where a sample looks like an expert's, and all four forms grow with it.
    """
    return jax.lax.switch(form, (r1, r2, r3, r4), logits)

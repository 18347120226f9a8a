"""The discriminator: tells relabelled samples from the policy's own.

Sign. The paper's equations drive D to 1 on samples of the *policy*. Here the logit, called `dis` in the paper, is the
*expert-like* one: D = 1 - σ(dis). Cross-entropy therefore labels expert (here relabelled) samples 1 and the policy's
own samples 0; at its optimum dis = log p_expert(s, a) - log p_policy(s, a), and a reward that grows with dis draws the
policy towards the expert's samples.
"""

import jax
import jax.numpy as jnp
import optax


def discriminator_loss(expert_logits: jax.Array, policy_logits: jax.Array) -> jax.Array:
    """Binary cross-entropy, `[]`: expert samples `[B]` towards 1 plus policy samples `[B]` towards 0.

    At chance it is 2 log 2, about 1.39.
    """
    expert = optax.sigmoid_binary_cross_entropy(expert_logits, jnp.ones_like(expert_logits))
    policy = optax.sigmoid_binary_cross_entropy(policy_logits, jnp.zeros_like(policy_logits))
    return expert.mean() + policy.mean()


def discriminator_accuracy(expert_logits: jax.Array, policy_logits: jax.Array) -> jax.Array:
    """Share of samples on the right side of 0, `[]`; one half is chance."""
    return 0.5 * (jnp.mean(expert_logits > 0) + jnp.mean(policy_logits <= 0))

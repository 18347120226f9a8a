"""The hindsight transformation: Algorithm 1 of the paper."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hgail_jax.validation import check_share

FUTURE, FINAL = range(2)


class Hindsight(NamedTuple):
    """The transformed goals of a trajectory of `T` steps."""

    goal: jax.Array
    """`[T, goal_size]`: where chosen, the position achieved at `source`; elsewhere the desired goal."""
    chosen: jax.Array
    """`[T]` booleans: the steps whose goal is replaced."""
    source: jax.Array
    """`[T]` integers in [0, T]: the step whose achieved goal replaces this step's."""


def relabel(
    rng: jax.Array,
    achieved: jax.Array,
    desired: jax.Array,
    p_ht: jax.Array | float,
    strategy: jax.Array | int = FUTURE,
    include_current: jax.Array | bool = False,
) -> Hindsight:
    """Replaces goals of one trajectory by positions it reached later; `jax.vmap` it over trajectories.

    Step `j` acts in state `s_j` and leads to `s_{j+1}`. It is chosen with probability `p_ht`; a chosen step's goal
    becomes the achieved goal of `s_l`.

    Args:
      rng: a PRNG key.
      achieved: `[T + 1, goal_size]`, the achieved goals of `s_0` to `s_T`.
      desired: `[goal_size]`, the goal that the trajectory pursued.
      p_ht: probability of choosing a step.
      strategy: `FUTURE`, with `l` uniform over `j+1..T`, or `FINAL`, with `l = T`.
      include_current: let "future" draw from `j..T` instead.

    Raises:
      ValueError: the shapes do not fit, or `p_ht` is no probability.

    """
    if achieved.ndim != 2 or len(achieved) < 2 or desired.shape != achieved.shape[1:]:
        raise ValueError(
            f"achieved and desired have the shapes {achieved.shape} and {desired.shape}; they must be"
            " [T + 1, goal_size] and [goal_size], with T at least 1"
        )
    check_share("p_ht", p_ht)
    length = achieved.shape[0] - 1
    chosen_rng, source_rng = jax.random.split(rng)
    chosen = jax.random.bernoulli(chosen_rng, p_ht, (length,))
    first = jnp.arange(length) + jnp.where(include_current, 0, 1)
    future = jax.random.randint(source_rng, (length,), first, length + 1)
    source = jnp.where(strategy == FINAL, length, future)
    return Hindsight(jnp.where(chosen[:, None], achieved[source], desired), chosen, source)

"""The hindsight transformation: Algorithm 1 of the paper.

Its probability `p_ht` is a hyperparameter (`config`), with defaults by task in `settings/defaults`.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from hgail_envs.validation import check_fraction

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
    kind: jax.Array | None = None,
    kind_share: jax.Array | None = None,
) -> Hindsight:
    """Replaces goals of one trajectory by positions it reached later; `jax.vmap` it over trajectories.

    Step `j` acts in state `s_j` and leads to `s_{j+1}`. It is chosen with probability `p_ht`; a chosen step's goal
    becomes the achieved goal of `s_l`.

    Args:
      rng: a PRNG key.
      achieved: `[T + 1, goal_size]`, the achieved goals of `s_0` to `s_T`.
      desired: `[T, goal_size]`, the goals that the trajectory pursued; `[goal_size]` if it was one.
      p_ht: probability of choosing a step.
      strategy: `FUTURE`, with `l` uniform over `j+1..T`, or `FINAL`, with `l = T`.
      include_current: let "future" draw from `j..T` instead.
      kind: `[T + 1]` integers below `K`, the kinds of the achieved goals; None is one kind. "future" first draws a kind
        among those ahead, then `l` uniformly among its steps.
      kind_share: `[K]`, positive: how often each kind is drawn where all lie ahead.

    Raises:
      ValueError: the shapes do not fit, or `p_ht` is no probability.
    """
    length = len(achieved) - 1
    fitting = (achieved.shape[1:], (length, *achieved.shape[1:]))
    if achieved.ndim != 2 or length < 1 or desired.shape not in fitting:
        raise ValueError(
            f"achieved and desired have the shapes {achieved.shape} and {desired.shape}; they must be"
            " [T + 1, goal_size] and [T, goal_size] or [goal_size], with T at least 1"
        )
    check_fraction("p_ht", p_ht)
    chosen_rng, source_rng = jax.random.split(rng)
    chosen = jax.random.bernoulli(chosen_rng, p_ht, (length,))
    first = jnp.arange(length) + jnp.where(include_current, 0, 1)
    if kind is None or kind_share is None:
        kind, kind_share = jnp.zeros(length + 1, jnp.int32), jnp.ones(1)
    future = _draw_future(source_rng, first, kind, kind_share)
    source = jnp.where(strategy == FINAL, length, future)
    return Hindsight(jnp.where(chosen[:, None], achieved[source], desired), chosen, source)


def _draw_future(rng: jax.Array, first: jax.Array, kind: jax.Array, kind_share: jax.Array) -> jax.Array:
    """Draws a state for each step, from `first`, `[T]`, on: a kind among those ahead, then one of its states.

    The states' `kind` is `[T + 1]` integers below `K`, and `kind_share`, `[K]`, how often each is drawn.
    """
    ahead = jnp.arange(len(kind))[None] >= first[:, None]
    states_of_kind = jnp.maximum(ahead.astype(jnp.float32) @ jax.nn.one_hot(kind, len(kind_share)), 1.0)
    weight = jnp.where(ahead, kind_share[kind][None] / states_of_kind[:, kind], 0.0)
    rngs = jax.random.split(rng, len(first))
    return jax.vmap(lambda rng, weight: jax.random.choice(rng, len(kind), p=weight))(rngs, weight)


def count_kinds(kind: jax.Array, kinds: int) -> jax.Array:
    """Returns how many states before each one have each kind, `[..., T + 2, kinds]`, from kinds `[..., T + 1]`."""
    before = jnp.cumsum(jax.nn.one_hot(kind, kinds, dtype=jnp.int32), axis=-2)
    return jnp.concatenate([jnp.zeros_like(before[..., :1, :]), before], axis=-2)


def draw_source(
    rng: jax.Array,
    counts: jax.Array,
    episode: jax.Array,
    first: jax.Array,
    last: jax.Array,
    share: jax.Array,
    strategy: jax.Array | int = FUTURE,
) -> jax.Array:
    """Draws the states whose achieved goals replace those of single steps, `[B]`, by Algorithm 1.

    The distribution is that of `relabel`: "future" draws a kind of goal among those ahead by its share, then one of its
    states uniformly; "final" takes the last. It costs a search of log T steps where `relabel` weighs all T + 1 states.

    The `counts`, `[episodes, T + 2, K]`, are from `count_kinds`. Of the `episode` of each step, `[B]`, the states from
    `first` to `last`, `[B]`, may be drawn; `share`, `[K]`, is positive.
    """
    kind_uniform, state_uniform = jax.random.uniform(rng, (2, *episode.shape))
    before = counts[episode, first]
    ahead = counts[episode, last + 1] - before
    cumulative = jnp.cumsum(jnp.where(ahead > 0, share, 0.0), axis=-1)
    # Rounding may leave the sum at the number drawn; then the last kind that is ahead is taken.
    latest = ahead.shape[-1] - 1 - jnp.argmax(ahead[:, ::-1] > 0, axis=-1)
    kind = jnp.minimum((cumulative <= kind_uniform[:, None] * cumulative[:, -1:]).sum(axis=-1), latest)

    def of_kind(array: jax.Array) -> jax.Array:
        return jnp.take_along_axis(array, kind[:, None], axis=-1)[:, 0]

    number = of_kind(ahead)
    rank = of_kind(before) + jnp.minimum((state_uniform * number.astype(jnp.float32)).astype(jnp.int32), number - 1)
    drawn = bisect(lambda state: counts[episode, state + 1, kind] > rank, first, last, counts.shape[1])
    return jnp.where(strategy == FINAL, last, drawn)


def bisect(test: Callable[[jax.Array], jax.Array], low: jax.Array, high: jax.Array, most: int) -> jax.Array:
    """Returns the first integers from `low` to `high`, less than `most` apart, that pass a test, as greater ones do."""

    def halve(_: jax.Array, bounds: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = bounds
        middle = (low + high) // 2
        passes = test(middle)
        return jnp.where(passes, low, middle + 1), jnp.where(passes, middle, high)

    return jax.lax.fori_loop(0, most.bit_length(), halve, (low, high))[0]

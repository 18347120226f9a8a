"""Turns vmaps around a function of a batch into a larger batch."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

OfBatch = Callable[..., jax.Array]
"""Arrays `[N, ...]` to an array `[N, ...]`."""


def as_one_batch(function: OfBatch) -> OfBatch:
    """Returns a function that, under any number of vmaps, calls `function` once for the batches of all of them.

    So a library whose buffers are for a fixed number of rows, and that cannot be batched itself, sees a single batch.
    The function is traced once for each size on the way, and runs for the last alone.
    """
    batched = jax.custom_batching.custom_vmap(function)

    @batched.def_vmap
    def _(axis_size: int, is_batched: Sequence[bool], *arguments: jax.Array) -> tuple[jax.Array, bool]:
        whole = [
            values if there else jnp.broadcast_to(values, (axis_size, *values.shape))
            for values, there in zip(arguments, is_batched, strict=True)
        ]
        results = batched(*(values.reshape(-1, *values.shape[2:]) for values in whole))
        return results.reshape(axis_size, -1, *results.shape[1:]), True

    return batched

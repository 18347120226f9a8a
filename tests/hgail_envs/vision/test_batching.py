"""Vmaps around a function of a batch become a larger batch."""

import jax
import jax.numpy as jnp
import numpy as np

from hgail_envs.vision.batching import as_one_batch


def test_each_row_comes_back_in_its_place_from_one_batch_of_all():
    sizes = []

    def add(one, other):
        sizes.append(len(one))
        return one[:, :2] * 10.0 + other

    function, one, other = as_one_batch(add), jnp.arange(24.0).reshape(2, 4, 3), jnp.arange(4.0).reshape(4, 1)

    def scanned(one):
        return jax.lax.scan(lambda total, _: (total + 1.0, function(one + total, other)), 0.0, None, 3)[1]

    results = jax.jit(jax.vmap(scanned))(one)
    expected = np.stack([10.0 * (one[..., :2] + step) + other for step in range(3)], axis=1)
    np.testing.assert_array_equal(results, expected)
    assert sizes[-1] == 8

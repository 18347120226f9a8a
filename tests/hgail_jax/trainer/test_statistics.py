"""Intervals over seeds, against a printed table."""

import numpy as np
import pytest

from hgail_jax.trainer.statistics import confidence_interval


def test_intervals_are_student_s():
    """Against a printed table of t: 2.365 for 7 degrees of freedom."""
    values = np.array([0.9, 0.95, 1.0, 1.0, 0.85, 0.97, 0.99, 1.0])
    expected = 2.3646 * np.sqrt(np.sum((values - values.mean()) ** 2) / 7) / np.sqrt(8)
    assert confidence_interval(values) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("seeds", [1, 2])
def test_fewer_than_three_seeds_have_no_interval(seeds):
    values = np.linspace(0.9, 1.0, seeds)
    assert np.isnan(confidence_interval(values))
    assert np.isnan(confidence_interval(np.stack([values] * 4))).tolist() == [True] * 4

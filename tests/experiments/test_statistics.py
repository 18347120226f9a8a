"""Estimates over seeds, against closed forms and loops."""

import itertools

import numpy as np
import pytest

from experiments.paper.statistics import interquartile_mean, probability_of_improvement
from hgail_jax.trainer.statistics import confidence_interval

RNG = np.random.default_rng(0)


def percentiles(values, weights):
    """The 2.5th and 97.5th percentile of a distribution that is known whole."""
    order = np.argsort(values)
    cumulative = np.cumsum(np.asarray(weights)[order]) / np.sum(weights)
    return [np.asarray(values)[order][np.searchsorted(cumulative, share)] for share in (0.025, 0.975)]


@pytest.mark.parametrize("seeds", [1, 2])
def test_fewer_than_three_seeds_have_no_interval(seeds):
    for estimate in (interquartile_mean(np.ones(seeds)), probability_of_improvement(np.ones(seeds), np.zeros(3))):
        assert estimate.value == 1.0
        assert np.isnan(estimate[1:]).all()


def test_the_interquartile_mean_is_that_of_the_middle_half():
    values = RNG.permutation([-100.0, -50.0, 1.0, 2.0, 3.0, 6.0, 50.0, 1000.0])
    assert interquartile_mean(values).value == 3.0


def test_the_interval_of_an_interquartile_mean_is_that_of_all_resamples():
    """Of four seeds all 256 resamples can be listed."""
    values = np.array([0.1, 0.4, 0.5, 0.9])
    means = [np.sort(sample)[1:3].mean() for sample in itertools.product(values, repeat=4)]
    low, high = percentiles(means, np.ones(256))
    assert interquartile_mean(values)[1:] == pytest.approx((low, high), abs=0.02)


@pytest.mark.parametrize("sizes", [(8, 8), (5, 3)])
def test_the_probability_of_improvement_is_a_share_of_pairs(sizes):
    first, second = (RNG.integers(0, 4, size).astype(float) for size in sizes)
    expected = np.mean([1.0 if x > y else 0.5 if x == y else 0.0 for x in first for y in second])
    ours, reverse = probability_of_improvement(first, second), probability_of_improvement(second, first)
    assert ours.value == pytest.approx(expected)
    assert ours.value + reverse.value == pytest.approx(1.0)
    assert ours.low <= ours.value <= ours.high
    assert ours.low + reverse.high == pytest.approx(1.0, abs=0.05)


def test_the_interval_of_a_probability_of_improvement_is_that_of_all_resamples():
    """Of three seeds against three all 729 pairs of resamples can be listed."""
    first, second = np.array([1.0, 3.0, 5.0]), np.array([0.0, 3.0, 4.0])
    shares = [
        np.mean([(x > y) + 0.5 * (x == y) for x in one for y in other])
        for one in itertools.product(first, repeat=3)
        for other in itertools.product(second, repeat=3)
    ]
    assert probability_of_improvement(first, second)[1:] == pytest.approx(percentiles(shares, np.ones(729)), abs=0.06)


def test_the_same_values_have_the_same_interval():
    values = RNG.uniform(size=8)
    assert interquartile_mean(values) == interquartile_mean(values)


def test_intervals_are_student_s():
    """Against a printed table of t: 2.365 for 7 degrees of freedom."""
    values = np.array([0.9, 0.95, 1.0, 1.0, 0.85, 0.97, 0.99, 1.0])
    expected = 2.3646 * np.sqrt(np.sum((values - values.mean()) ** 2) / 7) / np.sqrt(8)
    assert confidence_interval(values) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("seeds", [1, 2])
def test_the_mean_of_fewer_than_three_seeds_has_no_interval(seeds):
    values = np.linspace(0.9, 1.0, seeds)
    assert np.isnan(confidence_interval(values))
    assert np.isnan(confidence_interval(np.stack([values] * 4))).tolist() == [True] * 4

"""Estimates over the seeds of one or two settings, with bootstrap intervals."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import stats

from hgail_jax.trainer.statistics import FEWEST, Estimate

_RESAMPLES = 5000
_TRIMMED = 0.25  # off either end


def interquartile_mean(values: np.ndarray) -> Estimate:
    """Returns the mean of the middle half of values, `[seeds]`, and its interval by a bootstrap.

    As Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice", have it; the
    interval is that of percentiles. With three values or fewer none is trimmed.

    >>> interquartile_mean(np.array([0.0, 0.0, 0.5, 0.6, 0.7, 0.8, 1.0, 1.0])).value
    0.65
    """
    return _bootstrap(functools.partial(stats.trim_mean, proportiontocut=_TRIMMED), (values,))


def probability_of_improvement(first: np.ndarray, second: np.ndarray) -> Estimate:
    """Returns the probability that a seed of the first is better than one of the second, P(X > Y); ties count half.

    The interval is a bootstrap's, which draws the seeds of either again.

    Args:
      first: `[seeds]`, larger is better.
      second: `[seeds]`, as many or not.

    >>> probability_of_improvement(np.array([1.0, 2.0]), np.array([1.0, 0.0])).value
    0.875
    """

    def statistic(first: np.ndarray, second: np.ndarray, axis: int) -> Any:
        one, other = np.moveaxis(first, axis, -1)[..., :, None], np.moveaxis(second, axis, -1)[..., None, :]
        return ((one > other) + 0.5 * (one == other)).mean(axis=(-2, -1))

    return _bootstrap(statistic, (first, second))


def _bootstrap(statistic: Callable[..., Any], samples: tuple[np.ndarray, ...]) -> Estimate:
    """Returns the statistic of samples `[seeds]`, and its bootstrap interval, always with the same draws."""
    samples = tuple(np.asarray(sample, float) for sample in samples)
    value = float(statistic(*samples, axis=-1))
    if min(len(sample) for sample in samples) < FEWEST:
        return Estimate(value, np.nan, np.nan)
    found = stats.bootstrap(
        samples, statistic, n_resamples=_RESAMPLES, vectorized=True, method="percentile", rng=np.random.default_rng(0)
    )
    return Estimate(value, *map(float, found.confidence_interval))

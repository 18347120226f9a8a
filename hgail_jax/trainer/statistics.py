"""Estimates over seeds, with intervals."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy import special  # scipy.stats takes a quarter of a second to import, which a run does without

_RESAMPLES = 5000
_TRIMMED = 0.25  # off either end
_FEWEST = 3  # values that have an interval


class Estimate(NamedTuple):
    """A number and the 95 % interval around it; the bounds are NaN with fewer than three seeds."""

    value: float
    low: float
    high: float


def confidence_interval(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Returns half the width of the 95 % interval of the mean by Student's t; NaN of fewer than three values.

    Of two it would be nine times as wide as they are apart.

    >>> round(float(confidence_interval(np.array([1.0, 2.0, 3.0]))), 3)
    2.484
    """
    values = np.asarray(values, float)
    count = values.shape[axis]
    if count < _FEWEST:
        return np.full(values.mean(axis=axis).shape, np.nan)
    return special.stdtrit(count - 1, 0.975) * values.std(axis=axis, ddof=1) / np.sqrt(count)


def success_interval(success: float, episodes: int) -> Estimate:
    """Returns the rate of success of one policy in some episodes, and its 95 % interval by Wilson's formula.

    >>> [round(bound, 4) for bound in success_interval(0.5, 10)]
    [0.5, 0.2366, 0.7634]
    """
    z = special.ndtri(0.975)
    scale = 1.0 + z**2 / episodes
    middle = (success + z**2 / (2 * episodes)) / scale
    half = z * np.sqrt(success * (1.0 - success) / episodes + (z / (2 * episodes)) ** 2) / scale
    return Estimate(success, float(max(middle - half, 0.0)), float(min(middle + half, 1.0)))


def interquartile_mean(*strata: np.ndarray) -> Estimate:
    """Returns the mean of the middle half of all values, and its interval by a stratified bootstrap.

    As Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice", have it: seeds are
    drawn again within each stratum, and the interval is that of percentiles. With three values or fewer none is
    trimmed.

    Args:
      *strata: `[seeds]` each: one array for each task that is averaged over, or a single one.

    >>> interquartile_mean(np.array([0.0, 0.0, 0.5, 0.6, 0.7, 0.8, 1.0, 1.0])).value
    0.65

    """
    from scipy import stats

    def statistic(*strata: np.ndarray, axis: int) -> Any:
        return stats.trim_mean(np.concatenate(strata, axis=axis), _TRIMMED, axis=axis)

    return _bootstrap(statistic, strata)


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
    from scipy import stats

    samples = tuple(np.asarray(sample, float) for sample in samples)
    value = float(statistic(*samples, axis=-1))
    if min(len(sample) for sample in samples) < _FEWEST:
        return Estimate(value, np.nan, np.nan)
    found = stats.bootstrap(
        samples, statistic, n_resamples=_RESAMPLES, vectorized=True, method="percentile", rng=np.random.default_rng(0)
    )
    return Estimate(value, *map(float, found.confidence_interval))

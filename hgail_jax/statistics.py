"""Intervals over seeds."""

import numpy as np
from scipy import stats


def confidence_interval(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Returns half the width of the 95 % interval of the mean by Student's t; not a number where n is 1.

    >>> round(float(confidence_interval(np.array([1.0, 2.0, 3.0]))), 3)
    2.484
    """
    values = np.asarray(values, float)
    count = values.shape[axis]
    if count < 2:
        return np.full(values.mean(axis=axis).shape, np.nan)
    return stats.t.ppf(0.975, count - 1) * values.std(axis=axis, ddof=1) / np.sqrt(count)

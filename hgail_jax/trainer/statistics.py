"""Estimates over seeds, with intervals."""

from typing import NamedTuple

import numpy as np
from scipy import special  # scipy.stats takes a quarter of a second to import, which a run does without

FEWEST = 3
"""Fewest seeds that have an interval."""


class Estimate(NamedTuple):
    """A number and the 95 % interval around it; the bounds are NaN with fewer than three seeds."""

    value: float
    low: float
    high: float


def confidence_interval(values: np.ndarray) -> np.ndarray:
    """Returns half the width of the 95 % interval of means over seeds, `[..., seeds]`, by Student's t.

    It is NaN of fewer than three values; of two it would be nine times as wide as they are apart.

    >>> round(float(confidence_interval(np.array([1.0, 2.0, 3.0]))), 3)
    2.484
    """
    values = np.asarray(values, float)
    count = values.shape[-1]
    if count < FEWEST:
        return np.full(values.mean(axis=-1).shape, np.nan)
    return special.stdtrit(count - 1, 0.975) * values.std(axis=-1, ddof=1) / np.sqrt(count)


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

"""Pictures of depth: how far what is seen is from the camera's plane, as a depth camera measures it."""

from types import ModuleType
from typing import Any

import numpy as np

# Every table's top, an object on it and the hand are within 1.6 m of the cameras that stand in the room; 255 steps of
# 6.3 mm are as fine as a depth camera measures there. The wrist's camera sees the palm at 5 cm: black is 0.
FAR = 1.6
"""Distance that is white, metres; 0 is black."""


def as_picture(distance: Any, xp: ModuleType = np) -> Any:
    """Returns distances from the camera's plane, metres, as uint8; where nothing was measured, which is 0, it is white.

    The module `xp` computes, NumPy or JAX's.

    >>> as_picture([0.4, 1.6, 30.0, 0.0])
    array([ 64, 255, 255, 255], dtype=uint8)
    """
    distance = xp.asarray(distance)
    unit = xp.where(distance > 0.0, distance / FAR, 1.0)
    return xp.round(255.0 * xp.clip(unit, 0.0, 1.0)).astype(xp.uint8)

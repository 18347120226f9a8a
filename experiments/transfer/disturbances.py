"""What makes an episode harder in the robustness curves: how the target is misjudged and how actions are disturbed."""

import dataclasses
from collections.abc import Callable

from experiments.transfer.episode import Conditions, NoisyEstimate

_OFFSETS = (-0.03, -0.015, 0.0, 0.015, 0.03)  # metres


@dataclasses.dataclass(frozen=True)
class Disturbance:
    """A quantity that an episode is disturbed by."""

    axis: str
    """Label of the x axis, with the unit."""
    values: tuple[float, ...]
    """Values to measure, in order; the undisturbed one is among them."""
    conditions: Callable[[float], Conditions]
    """The conditions in which the quantity has a value and nothing else is disturbed."""


DISTURBANCES = {
    "noise": Disturbance(
        "noise of the target's position (m, σ per axis)",
        (0.0, 0.005, 0.01, 0.02, 0.03, 0.05),
        lambda metres: Conditions(NoisyEstimate(noise=metres)),
    ),
    "offset x": Disturbance(
        "constant offset in x (m)",
        _OFFSETS,
        lambda metres: Conditions(NoisyEstimate(offset=(metres, 0.0, 0.0))),
    ),
    "offset y": Disturbance(
        "constant offset in y (m), along which the hand closes",
        _OFFSETS,
        lambda metres: Conditions(NoisyEstimate(offset=(0.0, metres, 0.0))),
    ),
    "offset z": Disturbance(
        "constant offset in z (m)",
        _OFFSETS,
        lambda metres: Conditions(NoisyEstimate(offset=(0.0, 0.0, metres))),
    ),
    "delay": Disturbance(
        "delay of actions (steps)",
        (0, 1, 2, 3),
        lambda steps: Conditions(delay=int(steps)),
    ),
    "stride": Disturbance(
        "length of a step, times the trained one",
        (0.5, 0.75, 1.0, 1.25, 1.5),
        lambda factor: Conditions(stride=factor),
    ),
}
"""The disturbances by the names that the curves' rows have."""

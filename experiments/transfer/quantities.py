"""Quantities that the sweep varies, on other robots and on this project's own Fetch."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from experiments.transfer.conditions import TASKS, Conditions, NoisyEstimate

_OFFSETS = (-0.03, -0.015, 0.0, 0.015, 0.03)  # metres
_DEVIATIONS = (0.0, 0.005, 0.01, 0.02, 0.03)  # metres
_FACTORS = (0.5, 0.75, 1.0, 1.25, 1.5)
_WITH_OBJECT = ("grasp", "pick-and-place")
_WITH_OBJECT_IN_SIGHT = ("pick-and-place",)  # in grasp the policy sees it as the goal alone


@dataclasses.dataclass(frozen=True)
class Quantity:
    """Quantity of an episode that a sweep varies."""

    axis: str
    """Label of the x axis, with the unit."""
    values: tuple[float, ...]
    """Values to measure, in order, the nominal one among them."""
    conditions: Callable[[float], Conditions] | None = None
    """Conditions on another robot in which the quantity has a value and all others are nominal."""
    sizes: Callable[[float], Mapping[str, Any]] | None = None
    """Sizes of a `Randomization` of this project's Fetch, likewise."""
    tasks: tuple[str, ...] = tuple(TASKS)
    """Tasks that it affects."""


def _twice(name: str, number: Callable = float) -> Callable[[float], Mapping[str, Any]]:
    """Returns the sizes in which both ends of a range are a value."""
    return lambda value: {name: (number(value), number(value))}


QUANTITIES = {
    "noise": Quantity(
        "noise of the target's position (m, σ per axis, once per episode)",
        (*_DEVIATIONS, 0.05),
        lambda metres: Conditions(NoisyEstimate(noise=metres)),
        lambda metres: {"goal_offset": metres},
    ),
    "goal noise": Quantity(
        "noise of the target's position (m, σ per axis, at each step)",
        _DEVIATIONS,
        lambda metres: Conditions(goal_noise=metres),
        lambda metres: {"goal_noise": metres},
    ),
    "offset x": Quantity(
        "constant offset in x (m)",
        _OFFSETS,
        lambda metres: Conditions(NoisyEstimate(offset=(metres, 0.0, 0.0))),
    ),
    "offset y": Quantity(
        "constant offset in y (m), along which the hand closes",
        _OFFSETS,
        lambda metres: Conditions(NoisyEstimate(offset=(0.0, metres, 0.0))),
    ),
    "offset z": Quantity(
        "constant offset in z (m)",
        _OFFSETS,
        lambda metres: Conditions(NoisyEstimate(offset=(0.0, 0.0, metres))),
    ),
    "delay": Quantity(
        "delay of actions (steps)",
        (0, 1, 2, 3),
        lambda steps: Conditions(delay=int(steps)),
        _twice("delay", int),
    ),
    "stride": Quantity(
        "length of a step, times the trained one",
        (0.6, 0.8, 1.0, 1.2, 1.4),
        lambda factor: Conditions(stride=factor),
        _twice("step_size"),
    ),
    "gripper offset": Quantity(
        "error of the gripper's position (m, σ per axis, once per episode)",
        (0.0, 0.0025, 0.005, 0.01, 0.02),
        lambda metres: Conditions(robot_offset=metres),
        lambda metres: {"robot_offset": metres},
    ),
    "gripper noise": Quantity(
        "noise of the gripper's position (m, σ per axis, at each step)",
        (0.0, 0.001, 0.002, 0.005, 0.01),
        lambda metres: Conditions(robot_noise=metres),
        lambda metres: {"robot_noise": metres},
    ),
    "object offset": Quantity(
        "error of the object's position (m, σ per axis, once per episode)",
        _DEVIATIONS,
        sizes=lambda metres: {"object_offset": metres},
        tasks=_WITH_OBJECT_IN_SIGHT,
    ),
    "object noise": Quantity(
        "noise of the object's position (m, σ per axis, at each step)",
        _DEVIATIONS,
        sizes=lambda metres: {"object_noise": metres},
        tasks=_WITH_OBJECT_IN_SIGHT,
    ),
    "gravity": Quantity(
        "share of the arm's weight that is not compensated",
        (-0.1, -0.05, 0.0, 0.05, 0.1),
        lambda fraction: Conditions(gravity=fraction),
    ),
    "z_bias": Quantity(
        "sinking in each action, share of a full displacement",
        (-0.1, -0.05, 0.0, 0.05, 0.1),
        sizes=_twice("z_bias"),
    ),
    "friction": Quantity(
        "friction, times the model's",
        _FACTORS,  # at 2, MuJoCo's contacts are so soft that the fingers sink into the cube, which is then never held
        lambda factor: Conditions(friction=factor),
        _twice("friction"),
    ),
    "mass": Quantity(
        "mass of the cube, times the model's",
        (0.25, 0.5, 1.0, 1.5, 2.0),
        lambda factor: Conditions(object_mass=factor),
        _twice("object_mass"),
        tasks=_WITH_OBJECT,
    ),
    "size": Quantity(
        "width of the cube, times the model's",
        (0.8, 0.9, 1.0, 1.1, 1.2),
        sizes=_twice("object_size"),
        tasks=_WITH_OBJECT,
    ),
    "finger force": Quantity(
        "force of the fingers, times the model's", _FACTORS, sizes=_twice("finger_force"), tasks=_WITH_OBJECT
    ),
    "finger speed": Quantity(
        "speed of the fingers, times the model's", (0.25, *_FACTORS), sizes=_twice("finger_speed"), tasks=_WITH_OBJECT
    ),
    "posture": Quantity(
        "displacement of the gripper's start (m, at most, along each axis)",
        (0.0, 0.02, 0.04, 0.08, 0.12),
        sizes=lambda metres: {"posture": metres},
    ),
    "hand opening": Quantity(
        "opening of the hand at the start at most, share of the widest",
        (0.0, 0.25, 0.5, 0.75, 1.0),
        sizes=lambda fraction: {"hand_opening": fraction},
        tasks=_WITH_OBJECT,
    ),
}
"""Quantities by their names in the curves' rows."""

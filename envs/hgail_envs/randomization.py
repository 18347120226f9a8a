"""Sizes of domain randomisation, and the levels that have names."""

import dataclasses
from collections.abc import Mapping
from dataclasses import field
from typing import Any, Self

from hgail_envs.variation import ModelFactors

Range = tuple[float, float]
"""Bounds, least and most, of a uniform draw."""

MOST_DELAY = 50
"""Largest delay, steps: an episode of the Fetch tasks."""
_OLD_NAMES = {"sag": "z_bias", "growth": "ramp"}  # of fields, in policy files of earlier releases


def _limits(least: float, most: float, ramps: bool = True) -> dict[str, Any]:
    """Returns metadata of a size: the numbers that it may have, and whether it grows over `Randomization.ramp`."""
    return {"limits": (least, most), "ramps": ramps}


_FACTOR, _DEVIATION = _limits(0.01, 100), _limits(0, 10)


@dataclasses.dataclass(frozen=True)
class Randomization:
    """Sizes of the differences between episodes; by default there are none.

    Ranges are drawn uniformly, once per episode. Noises are drawn at each step and offsets once per episode, both
    Gaussian and independent for each coordinate. A size is declared here alone, with its limits: its default is the
    nominal value, a pair declares a range and an integer whole numbers. Its effect is in `RandomizedEnv`, or in the
    task if it is a field of `ModelFactors`. A size out of range is a ValueError.
    """

    delay: tuple[int, int] = field(default=(0, 0), metadata=_limits(0, MOST_DELAY))
    """Steps from an observation to the action that answers it, both bounds included; the robot first stands still."""
    step_size: Range = field(default=(1.0, 1.0), metadata=_FACTOR)
    """Factor on displacements, the first three numbers of an action."""
    z_bias: Range = field(default=(0.0, 0.0), metadata=_limits(-1, 1))
    """Fraction of a full displacement by which the gripper sinks in each action, like an arm whose gravity is
    compensated too little; it rises if this is negative."""
    robot_noise: float = field(default=0.0, metadata=_DEVIATION)
    """Standard deviation of the noise in the gripper's observed position, metres."""
    robot_offset: float = field(default=0.0, metadata=_DEVIATION)
    """Standard deviation of the offset in the gripper's observed position, metres."""
    object_noise: float = field(default=0.0, metadata=_DEVIATION)
    """Standard deviation of the noise in the object's observed position, metres."""
    object_offset: float = field(default=0.0, metadata=_DEVIATION)
    """Standard deviation of the offset in the object's observed position, metres."""
    goal_noise: float = field(default=0.0, metadata=_DEVIATION)
    """Standard deviation of the noise in the position of a goal, desired or achieved, metres."""
    goal_offset: float = field(default=0.0, metadata=_DEVIATION)
    """Standard deviation of the offset in the position of a goal, desired or achieved, metres."""
    friction: Range = field(default=(1.0, 1.0), metadata=_FACTOR)
    """Factor on the friction of all contacts."""
    object_mass: Range = field(default=(1.0, 1.0), metadata=_FACTOR)
    """Factor on the object's mass and its moments of inertia."""
    object_size: Range = field(default=(1.0, 1.0), metadata=_FACTOR)
    """Factor on the object's width, depth and height; its mass stays the same."""
    finger_force: Range = field(default=(1.0, 1.0), metadata=_FACTOR)
    """Factor on the force of the fingers' servos, whose speed stays the same."""
    finger_speed: Range = field(default=(1.0, 1.0), metadata=_FACTOR)
    """Factor on the speed of the fingers, whose force stays the same."""
    hand_width: Range = field(default=(1.0, 1.0), metadata=_FACTOR)
    """Factor on the widest gap between the fingers; a narrow hand is still wider than the object, see the task."""
    pad_size: Range = field(default=(1.0, 1.0), metadata=_FACTOR)
    """Factor on the width and the height of the fingers' pads; their thickness and their lower ends stay the same."""
    posture: float = field(default=0.0, metadata=_limits(0, 0.15, ramps=False))
    """Largest displacement of the gripper's start along each axis, metres, up to that of the goals of reach."""
    hand_opening: float = field(default=0.0, metadata=_limits(0, 1, ramps=False))
    """Largest opening of the hand at the start, as a fraction of its widest."""
    history: int = field(default=0, metadata=_limits(0, MOST_DELAY, ramps=False))
    """Number of last actions and observations that the policy observes besides the present observation."""
    known_delay: int = field(default=0, metadata=_limits(0, MOST_DELAY, ramps=False))
    """Longest delay, steps, that the policy knows: it observes so many actions that are on their way, which are sent
    and have not taken effect."""
    ramp: float = field(default=0.0, metadata=_limits(0, 1, ramps=False))
    """Fraction of the training's rounds over which the randomisation grows from nominal to these sizes; 0 starts with
    these. The start of an episode (`posture`, `hand_opening`) does not grow, nor does a delay that the policy knows."""

    def __post_init__(self) -> None:
        for size in dataclasses.fields(self):
            value = getattr(self, size.name)
            _check(size, value)
            if isinstance(size.default, tuple):  # so that (1, 1) is (1.0, 1.0) in a policy file, too
                object.__setattr__(self, size.name, tuple(map(type(size.default[0]), value)))

    @property
    def ramped(self) -> tuple[str, ...]:
        """Names of the fields that grow over the ramp."""
        growing = [size.name for size in dataclasses.fields(self) if size.metadata["ramps"]]
        # If a known delay grew, the longest would be drawn only late, and is learnt far later (docs/lab/robust.md).
        return tuple(name for name in growing if not (name == "delay" and self.known_delay))

    @property
    def varies_model(self) -> bool:
        """True if the model differs from one episode to the next."""
        return any(getattr(self, name) != (1.0, 1.0) for name in MODEL_FACTORS)

    @property
    def varies_start(self) -> bool:
        """True if the robot's posture at the start differs from one episode to the next."""
        return self.posture > 0 or self.hand_opening > 0

    @property
    def has_sensor_noise(self) -> bool:
        """True if the observed positions of gripper and object have errors."""
        return any((self.robot_noise, self.robot_offset, self.object_noise, self.object_offset))

    def nominal(self) -> Self:
        """Returns no randomisation, for observations of the same size."""
        return type(self)(history=self.history, known_delay=self.known_delay)

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """Rebuilds a randomisation from JSON, also with an earlier release's names; a ValueError for other fields."""
        content = {_OLD_NAMES.get(name, name): value for name, value in content.items()}
        unknown = set(content) - {size.name for size in dataclasses.fields(cls)}
        if unknown:
            raise ValueError(f"a randomisation has no field {min(unknown)!r}")
        # JSON has lists in place of tuples, which would be no ranges.
        sizes: dict[str, Any] = {name: tuple(one) if isinstance(one, list) else one for name, one in content.items()}
        return cls(**sizes)


def _check(size: dataclasses.Field, value: Any) -> None:
    nominal, (least, most) = size.default, size.metadata["limits"]
    ranged = isinstance(nominal, tuple)
    numbers = value if isinstance(value, tuple) else (value,)
    whole = isinstance(nominal[0] if isinstance(nominal, tuple) else nominal, int)
    kind = int if whole else (int, float)
    valid = len(numbers) == 1 + ranged and all(
        # bool is a subclass of int, and a NaN fails both comparisons
        isinstance(number, kind) and not isinstance(number, bool) and least <= number <= most
        for number in numbers
    )
    if not valid or numbers[0] > numbers[-1]:
        allowed = "a least and a most" if ranged else "an integer" if whole else "a number"
        raise ValueError(f"{size.name} is {value!r}; it must be {allowed} from {least} to {most}")


MODEL_FACTORS = tuple(size.name for size in dataclasses.fields(ModelFactors))
"""Fields of `Randomization` that are ranges of the fields of `ModelFactors`."""

OF_OBJECT = tuple(size.name for size in dataclasses.fields(Randomization) if size.name.startswith("object_"))
"""Fields of `Randomization` that are of an object."""

_MILD = Randomization(
    delay=(0, 1),
    step_size=(0.8, 1.2),
    z_bias=(-0.02, 0.02),
    robot_noise=0.0005,
    robot_offset=0.002,
    object_noise=0.002,
    object_offset=0.005,
    goal_noise=0.002,
    goal_offset=0.005,
    friction=(0.8, 1.2),
    object_mass=(0.7, 1.2),
    object_size=(0.95, 1.05),
    finger_force=(0.8, 1.2),
    finger_speed=(0.6, 1.1),
    hand_width=(0.85, 1.05),
    pad_size=(0.85, 1.15),
    posture=0.02,
    hand_opening=1.0,
    ramp=0.5,
)
_FULL = dataclasses.replace(
    _MILD,
    delay=(0, 3),
    step_size=(0.6, 1.4),
    z_bias=(-0.05, 0.05),
    robot_noise=0.001,
    friction=(0.5, 1.5),
    object_mass=(0.25, 1.5),
    object_size=(0.85, 1.4),
    finger_force=(0.5, 1.3),
    finger_speed=(0.2, 1.5),
    hand_width=(0.7, 1.1),
    pad_size=(0.7, 1.3),
    posture=0.04,
)

# `full` without delay, with the nominal object, finger force, z_bias and start of the arm. Goals are off by more and
# steps may be shorter, for a hand that leaves the cube less room (docs/lab/robust.md, sizes for other arms).
_OTHER_ARMS = dataclasses.replace(
    _FULL,
    delay=(0, 0),
    step_size=(0.4, 1.4),
    z_bias=(0.0, 0.0),
    goal_offset=0.015,
    object_mass=(1.0, 1.0),
    object_size=(1.0, 1.0),
    finger_force=(1.0, 1.0),
    posture=0.0,
)

LEVELS: dict[str, Randomization] = {
    "none": Randomization(),
    "other-arms": _OTHER_ARMS,
    "mild": _MILD,
    "full": _FULL,
    "none-history": Randomization(history=1),
    "mild-history": dataclasses.replace(_MILD, history=3),
    "full-history": dataclasses.replace(_FULL, history=3),
    "full-known-delay": dataclasses.replace(_FULL, known_delay=_FULL.delay[1]),
}
"""Randomisations by name, as on the command line.

The hands of `full` include those of the arms in `experiments/transfer`: a Robotiq 2F-85 opens to 0.85 of the Fetch's
100 mm and takes as many actions as the Fetch's fingers at 0.23 to 0.78 of their speed if an action lasts 40 ms, and at
0.83 to 0.95 if it lasts 160 ms; a Franka's hand opens to 0.8, at 0.45 to 0.78 and 0.89 to 1.04.
"""

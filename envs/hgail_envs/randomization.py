"""How much an episode is disturbed by: the sizes of domain randomisation, and the levels that have names."""

import dataclasses
from collections.abc import Mapping
from typing import Any, Self

Range = tuple[float, float]
"""The least and the most of what is drawn uniformly, once per episode."""

MOST_DELAY = 50
"""Steps."""
MODEL_FACTORS = ("friction", "object_mass", "object_size", "finger_force", "finger_speed")
"""Fields of `Randomization` that are ranges of those of `ModelFactors`."""
_FACTORS = ("step_size", *MODEL_FACTORS)
_DEVIATIONS = ("robot_noise", "robot_offset", "object_noise", "object_offset", "goal_noise", "goal_offset")
RAMPED = ("delay", "z_bias", *_FACTORS, *_DEVIATIONS)
"""Fields of `Randomization` that its `ramp` is about."""
_OLD_NAMES = {"sag": "z_bias", "growth": "ramp"}  # as files of earlier releases name these fields
_RANGES = ("delay", "z_bias", *_FACTORS)
_LIMITS = {
    **{name: (0, MOST_DELAY) for name in ("delay", "history")},
    "z_bias": (-1, 1),
    **{name: (0.01, 100) for name in _FACTORS},
    **{name: (0, 10) for name in _DEVIATIONS},
    **{name: (0, 1) for name in ("hand_opening", "ramp")},
    "posture": (0, 0.15),  # as far as the goals of reach are from the start
}


@dataclasses.dataclass(frozen=True)
class Randomization:
    """Sizes of what differs from one episode to the next; by default nothing does.

    A noise is drawn anew at each step, an offset once per episode, both Gaussian for each coordinate; the others are
    uniform, once per episode.

    Raises:
      ValueError: a size is not finite, out of range, or not a least and a most.

    """

    delay: tuple[int, int] = (0, 0)
    """Steps from an observation to the action that answers it, both ends included; the robot first stands still."""
    step_size: Range = (1.0, 1.0)
    """Factor on displacements, the first three numbers of an action."""
    z_bias: Range = (0.0, 0.0)
    """Shares of a full displacement by which the gripper sinks in each action, as an arm does whose gravity is
    compensated too little; below 0 it rises."""
    robot_noise: float = 0.0
    """Standard deviation of the gripper's position that is observed, metres."""
    robot_offset: float = 0.0
    """Likewise, of what stays for an episode."""
    object_noise: float = 0.0
    """Standard deviation of the object's position that is observed, metres."""
    object_offset: float = 0.0
    """Likewise, of what stays for an episode."""
    goal_noise: float = 0.0
    """Standard deviation of the position in a goal, desired or achieved, metres."""
    goal_offset: float = 0.0
    """Likewise, of what stays for an episode."""
    friction: Range = (1.0, 1.0)
    """Factor on the friction of all contacts."""
    object_mass: Range = (1.0, 1.0)
    """Factor on the object's mass."""
    object_size: Range = (1.0, 1.0)
    """Factor on the object's width, depth and height."""
    finger_force: Range = (1.0, 1.0)
    """Factor on the force of the fingers' servos."""
    finger_speed: Range = (1.0, 1.0)
    """Factor on how fast they move the fingers."""
    posture: float = 0.0
    """Metres along each axis by which the gripper starts elsewhere at most."""
    hand_opening: float = 0.0
    """Share of its widest by which the hand is open at the start at most."""
    history: int = 0
    """Last actions and observations that the policy is shown besides the present observation."""
    ramp: float = 0.0
    """Share of a training's rounds in which the disturbances grow from none to these sizes; 0 is these from the start.
    The start of an episode is as different from the first round on."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            self._check(field.name, getattr(self, field.name))
        object.__setattr__(self, "delay", tuple(self.delay))
        for name in (*_FACTORS, "z_bias"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))

    @property
    def varies_model(self) -> bool:
        """Whether the model differs from one episode to the next."""
        return any(getattr(self, name) != (1.0, 1.0) for name in MODEL_FACTORS)

    @property
    def varies_start(self) -> bool:
        """Whether the robot starts elsewhere."""
        return self.posture > 0 or self.hand_opening > 0

    @property
    def has_sensor_noise(self) -> bool:
        """Whether the positions of gripper and object are observed wrongly."""
        return any((self.robot_noise, self.robot_offset, self.object_noise, self.object_offset))

    def nominal(self) -> Self:
        """Returns the randomisation without any disturbance, for which the policy is shown as much."""
        return type(self)(history=self.history)

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """Returns what `dataclasses.asdict` gave, after it was JSON.

        Raises:
          ValueError: there is no such field, or it cannot have such a value.

        """
        content = {_OLD_NAMES.get(name, name): value for name, value in content.items()}
        unknown = set(content) - {field.name for field in dataclasses.fields(cls)}
        if unknown:
            raise ValueError(f"a randomisation has no field {min(unknown)!r}")
        sizes: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in content.items()
        }
        return cls(**sizes)

    def _check(self, name: str, value: Any) -> None:
        """Refuses a value that the field cannot have."""
        least, most = _LIMITS[name]
        ranged, whole = name in _RANGES, name in ("delay", "history")
        numbers = value if isinstance(value, tuple) else (value,)
        kind = int if whole else (int, float)
        sound = len(numbers) == 1 + ranged and all(
            isinstance(number, kind) and not isinstance(number, bool) and least <= number <= most for number in numbers
        )
        if not sound or numbers[0] > numbers[-1]:
            allowed = "a least and a most" if ranged else "an integer" if whole else "a number"
            raise ValueError(f"{name} is {value!r}; it must be {allowed} from {least} to {most}")


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
    posture=0.02,
    hand_opening=1.0,
    ramp=0.5,
)
_FULL = Randomization(
    delay=(0, 3),
    step_size=(0.6, 1.4),
    z_bias=(-0.05, 0.05),
    robot_noise=0.001,
    robot_offset=0.002,
    object_noise=0.002,
    object_offset=0.005,
    goal_noise=0.002,
    goal_offset=0.005,
    friction=(0.5, 1.5),
    object_mass=(0.25, 1.5),
    object_size=(0.85, 1.4),
    finger_force=(0.5, 1.3),
    finger_speed=(0.3, 1.2),
    posture=0.04,
    hand_opening=1.0,
    ramp=0.5,
)

LEVELS: dict[str, Randomization] = {
    "none": Randomization(),
    "mild": _MILD,
    "full": _FULL,
    "mild-history": dataclasses.replace(_MILD, history=3),
    "full-history": dataclasses.replace(_FULL, history=3),
}
"""Randomisations by the names that the command line knows them by."""

"""The numbers of an arm, which a TOML file has."""

import dataclasses
import functools
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hgail_envs.robots.hand import PADS
from hgail_envs.scenes import assets_directory

_POSITIVE = ("torque", "top_speed", "servo_frequency", "lead", "payload", "scale", "size", "force", "stiffness")


@dataclasses.dataclass(frozen=True)
class Part:
    """A frame or a box that a body of the model carries; its x is where the hand points, and it closes along y."""

    body: str
    pos: Sequence[float] | np.ndarray
    """Metres."""
    quat: Sequence[float] | np.ndarray
    size: Sequence[float] | np.ndarray = (0.01, 0.01, 0.01)
    """Half its edges, metres."""


@dataclasses.dataclass(frozen=True)
class Hand:
    """A hand with a position servo for each of its driven joints."""

    joints: Sequence[str]
    """Names of the driven joints."""
    closed: Sequence[float]
    """Their positions when the hand is closed."""
    opened: Sequence[float]
    """Their positions when it is open."""
    force: float
    """Most force of a servo, N, or torque, N m."""
    stiffness: float
    """Of the servos, N/m or N m/rad."""
    damping: float
    armature: float
    """Inertia of the drive, kg or kg m²."""


@dataclasses.dataclass(frozen=True)
class Description:
    """An arm with a hand; `assets/robots/franka.toml` is an example."""

    model: str
    """MJCF of the arm, its base at the origin: a file of the package, or without one a file beside the description; or
    the text, in which `{package}` stands for the package's folder."""
    joints: Sequence[str]
    """Names of the arm's joints, all hinges, from the base on."""
    torque: Sequence[float]
    """Most torque of their servos, N m."""
    top_speed: Sequence[float]
    """Radians per second at most, by the maker's data sheet: MJCF has no such limit."""
    home: Sequence[float]
    """Joint positions that the arm stays near where the gripper's place leaves a choice, radians."""
    reach: Sequence[float]
    """Metres along x and y from the base to the gripper's start."""
    tool: Part
    """The point between the pads, 18.5 mm above their ends."""
    palm: Part
    right_pad: Part
    """The pad that opens along the tool's y."""
    left_pad: Part
    hand: Hand
    armature: float = 0.1
    """Inertia of the joints' drives, kg m²."""
    hand_model: str = ""
    """MJCF of the hand, whose names get the prefix `hand/`, where it is not in that of the arm."""
    flange: str = ""
    """Site of the arm that such a hand is attached to."""
    servo_frequency: float = 6.0
    """Natural frequency of the joints' servos, Hz, the same for all, or the gripper would not move straight. They are
    critically damped at the joint's largest inertia."""
    lead: float = 0.058
    """Metres of the scene by which the arm's servos lead the gripper for a unit action."""
    payload: float = 2.0
    """Most mass of an object, kg; heavier ones become as light."""
    clearance: float = 0.004
    """Metres between the table and the lowest end of the pads, below which the gripper is not led: larger where the
    fingers end below the pads. Servos that are at their limits let it sink farther."""
    meeting: float = 0.0
    """Metres along the tool's y from the point between the pads to where they meet, of a hand with one jaw."""
    tilt_weight: float = 0.15
    """Metres that count as much as a radian by which the hand does not point downward. Little, and an arm of few joints
    reaches farther where it tilts."""
    scale: float = 1.0
    """Metres of the scene to a metre of the robot, larger for a small arm. Masses and times stay; gravity, in the
    scene's metres, is so much larger."""
    package: str = ""
    """Python package that has the model's files."""
    extra: str = ""
    """Extra of this package that installs it."""


def is_file(name: str) -> bool:
    """Returns whether a robot's name is the file of a description of a user's own."""
    return name.endswith(".toml")


def text_of(name: str) -> str:
    """Returns the text of a robot's description, which may change between two tasks; a ValueError if there is none."""
    try:
        return _path_of(name).read_text()
    except OSError:
        raise ValueError(
            f"robot {name!r}: there is no file {name}; name it by its place from here, or make one by hgail robot"
        ) from None


def _path_of(name: str) -> Path:
    return Path(name) if is_file(name) else assets_directory() / "robots" / f"{name}.toml"


def read_description(name: str) -> Description:
    """Reads `assets/robots/<name>.toml`, or a file of a user's own, whose name ends with `.toml`.

    A ValueError of one line says what is wrong with it.
    """
    return _parsed(name, text_of(name))


@functools.cache
def _parsed(name: str, text: str) -> Description:
    path = _path_of(name)
    try:
        content = tomllib.loads(text)
        parts: dict[str, Any] = {part: Part(**content.pop(part)) for part in ("tool", "palm", *PADS)}
        arm = Description(hand=Hand(**content.pop("hand")), **parts, **content)
    except KeyError as missing:
        raise ValueError(f"robot {name!r}: {path} has no [{missing.args[0]}]") from None
    except (tomllib.TOMLDecodeError, TypeError) as error:
        line = str(error).replace(".__init__() got an unexpected keyword argument", " has no field")
        raise ValueError(f"robot {name!r}: {path}: {line.replace('.__init__()', '')}") from None
    try:
        _check(arm)
    except ValueError as error:
        raise ValueError(f"robot {name!r}: {path}: {error}") from None
    return arm


def _check(arm: Description) -> None:
    """Raises a ValueError for the first value of a wrong kind, count or sign."""
    for title, names in (("joints", arm.joints), ("hand.joints", arm.hand.joints)):
        if not (names and isinstance(names, list) and all(isinstance(name, str) for name in names)):
            raise ValueError(f"{title} is {names!r}, and must be names of joints")
    joints, drives = len(arm.joints), len(arm.hand.joints)
    _check_numbers("", arm, {"torque": joints, "top_speed": joints, "home": joints, "reach": 2})
    _check_numbers("hand.", arm.hand, {"closed": drives, "opened": drives})
    for part in ("tool", "palm", *PADS):
        _check_numbers(f"{part}.", getattr(arm, part), {"pos": 3, "quat": 4, "size": 3})
        if not any(getattr(arm, part).quat):
            raise ValueError(f"{part}.quat is 0, which is no orientation")
    if arm.hand.closed == arm.hand.opened:
        raise ValueError("hand.closed and hand.opened are the same, so that the hand does not move")


def _check_numbers(title: str, table: Any, counts: Mapping[str, int]) -> None:
    """Checks the fields of a table that are one number each, and those that are `counts` numbers."""
    for name in (field.name for field in dataclasses.fields(table) if field.type is float or field.name in counts):
        value = getattr(table, name)
        numbers = value if name in counts else [value]
        if not isinstance(numbers, list | tuple) or not all(isinstance(one, float | int) for one in numbers):
            raise ValueError(f"{title}{name} is {value!r}, and must be {'numbers' if name in counts else 'a number'}")
        if len(numbers) != counts.get(name, 1):
            raise ValueError(f"{title}{name} has {len(numbers)} numbers, and must have {counts[name]}")
        if not np.isfinite(numbers).all() or (name in _POSITIVE and min(numbers) <= 0.0):
            above = " and above 0" if name in _POSITIVE else ""
            raise ValueError(f"{title}{name} is {value!r}, and must be finite{above}")

"""Names, units and frames of each number that a task's policy reads and of each that it commands."""

from collections.abc import Sequence
from typing import NamedTuple

from hgail_envs.registry import TASKS, find_class
from hgail_envs.validation import check_name


class Quantity(NamedTuple):
    """A number of an observation, a goal or an action."""

    name: str
    unit: str
    """`"m"`, `"rad"`, `"0 or 1"` and so on; empty if it is not known."""
    frame: str
    """A name in `FRAMES`; empty for a number that has none."""


class Description(NamedTuple):
    """The numbers that a policy of a task reads and commands, in their order."""

    features: tuple[Quantity, ...]
    """Of the observation before the goal, with the past if it has one."""
    goal: tuple[Quantity, ...]
    action: tuple[Quantity, ...]
    """Each from -1 to 1."""


FRAMES = {
    "world": "of the scene: x ahead of the robot, y to its left, z up, origin on the floor; also the axes of relative"
    " positions and of velocities",
    "hand": "of the hand: each finger moves along its own axis, and 0 is closed",
}
"""Meaning of the frames."""

_AXES = ("x", "y", "z")
_PER_ACTION = "m per action of 0.04 s"


def _vector(name: str, unit: str = "m", frame: str = "world") -> tuple[Quantity, ...]:
    return tuple(Quantity(f"{name} {axis}", unit, frame) for axis in _AXES)


def _fingers(name: str, unit: str) -> tuple[Quantity, ...]:
    return tuple(Quantity(f"{name} of the {side} finger", unit, "hand") for side in ("right", "left"))


_GRIPPER = (*_vector("gripper position"), *_vector("gripper velocity", _PER_ACTION))
_GAP = Quantity("gap between the fingers", "m", "hand")
_HAND = (_GAP, Quantity("hand holds the cube", "0 or 1", ""))
_HOLDS_A = Quantity("hand holds cube A", "0 or 1", "")
_TARGET = _vector("target position")
_OF_OBJECT = (*_TARGET, Quantity("target is the object's, not the gripper's", "0 or 1", ""))
_OF_CUBES = (
    *(Quantity(f"target is cube {cube}'s", "0 or 1", "") for cube in "AB"),
    Quantity("cube A is to be left at the target", "0 or 1", ""),
)
_ROLES = ("top", "middle", "base")
_OF_GOAL = ("target's cube", "cube below it", "third cube")
_OF_TOWER = (
    *(Quantity(f"target is the {role} cube's", "0 or 1", "") for role in _ROLES),
    Quantity("the cube is to be left at the target", "0 or 1", ""),
)


def _object(name: str) -> tuple[Quantity, ...]:
    relative = _vector(f"{name} position less gripper position")
    return (*relative, *_vector(f"{name} position"), *_vector(f"{name} velocity", _PER_ACTION))


def _official(name: str) -> tuple[Quantity, ...]:
    """Returns the quantities of `hgail_envs.fetch.objects.ObjectEnv.official_features`."""
    return (
        *_vector("gripper position"),
        *_vector(f"{name} position"),
        *_vector(f"{name} position less gripper position"),
        *_fingers("position", "m"),
        *_vector(f"{name} rotation, Euler angle", "rad"),
        *_vector(f"{name} velocity less gripper velocity", _PER_ACTION),
        *_vector(f"{name} angular velocity", "rad per action of 0.04 s"),
        *_vector("gripper velocity", _PER_ACTION),
        *_fingers("velocity", _PER_ACTION),
    )


_FEATURES = {
    "point": _vector("position"),
    "reach": _GRIPPER,
    "grasp": (*_GRIPPER, *_HAND),
    "grasp-position": (*_GRIPPER, *_HAND),
    "grasp-aperture": (*_GRIPPER, *_HAND),
    "push": (*_GRIPPER, *_object("cube")),
    "pick-and-place": (*_GRIPPER, *_object("cube"), *_HAND),
    "slide": (*_GRIPPER, *_object("puck")),
    "stack": (*_GRIPPER, *_object("cube A"), _GAP, _HOLDS_A, *_object("cube B")),
    "tower": (
        *_GRIPPER,
        *(quantity for cube in _OF_GOAL for quantity in _object(cube)),
        _GAP,
        Quantity("hand holds a cube", "0 or 1", ""),
    ),
}
_OTHER_FEATURES = {
    "grasp": {"tracked": (*_GRIPPER, *_HAND, *_vector("cube position less gripper position"))},
    "push": {"official": _official("cube")},
    "pick-and-place": {"official": _official("cube")},
    "slide": {"official": _official("puck")},
}
_GOALS = {
    "point": _TARGET,
    "reach": _TARGET,
    "grasp": (*_TARGET, Quantity("to hold the cube at the target", "0 or 1", "")),
    "grasp-position": _TARGET,
    "grasp-aperture": (*_TARGET, Quantity("desired gap between the fingers", "m", "hand")),
    "push": _OF_OBJECT,
    "pick-and-place": _OF_OBJECT,
    "slide": _OF_OBJECT,
    "stack": (*_TARGET, *_OF_CUBES),
    "tower": (*_TARGET, *_OF_TOWER),
}
_ARM = _vector("gripper displacement", "1 is about 0.033 m")
_HAND_COMMAND = Quantity("hand: positive opens, negative closes", "1 drives the fingers to their stops", "hand")
_BLOCKED = Quantity("hand: no effect, the fingers are blocked", "", "hand")
_ON_ITS_WAY = Quantity("whether there is an action", "0 or 1", "")
_BLOCKS_FINGERS = ("reach", "push", "slide")


def describe(
    task: str, observation: str = "compact", history: int = 0, known_delay: int = 0, sizes: Sequence[int] = ()
) -> Description:
    """Describes the numbers of a task of the package; those of other tasks are numbered.

    Args:
      task: a name in `hgail_envs.TASKS`, or `"module:Class"`.
      observation: `"compact"`, or of some tasks `"official"`, see `hgail_envs.fetch.objects.ObjectEnv`, or `"tracked"`,
        see `hgail_envs.fetch.grasp.Grasp`.
      history: past actions and observations before the present observation, see `Randomization.history`.
      known_delay: actions on their way, before the history, see `Randomization.known_delay`.
      sizes: of features without history, goal and action, for a task of one's own; empty are those of its class.

    >>> describe("reach").features[3]
    Quantity(name='gripper velocity x', unit='m per action of 0.04 s', frame='world')
    >>> describe("reach", history=1).features[0].name
    'gripper displacement x, 1 step earlier'

    """
    if task in TASKS:
        by_name = {"compact": _FEATURES[task]} | _OTHER_FEATURES.get(task, {})
        check_name(f"observation of {task}", observation, by_name)
        features = by_name[observation]
        goal = _GOALS[task]
        hand = _BLOCKED if task in _BLOCKS_FINGERS else _HAND_COMMAND
        action = _vector("displacement", "1 is 0.03 m") if task == "point" else (*_ARM, hand)
    else:
        of_class = find_class(task) if not sizes else None
        counts = (of_class.feature_size, of_class.goal_size, of_class.action_size) if of_class else sizes
        kinds = ("feature", "goal", "action")
        features, goal, action = (
            tuple(Quantity(f"{kind} {index}", "", "") for index in range(count))
            for kind, count in zip(kinds, counts, strict=True)
        )
    past = *_on_their_way(action, known_delay), *_past(action, features, history)
    return Description((*past, *features), goal, action)


def _on_their_way(action: tuple[Quantity, ...], known_delay: int) -> tuple[Quantity, ...]:
    """Returns the quantities of the actions on their way, the newest first; those of none are 0."""
    return tuple(
        quantity._replace(name=f"{quantity.name}, sent {back} step{'s' if back > 1 else ''} ago and on its way")
        for back in range(1, known_delay + 1)
        for quantity in (_ON_ITS_WAY, *action)
    )


def _past(action: tuple[Quantity, ...], features: tuple[Quantity, ...], history: int) -> tuple[Quantity, ...]:
    """Returns the quantities of a history: the newest action and the features that it answered, then older ones."""
    return tuple(
        quantity._replace(name=f"{quantity.name}, {back} step{'s' if back > 1 else ''} earlier")
        for back in range(1, history + 1)
        for quantity in (*action, *features)
    )

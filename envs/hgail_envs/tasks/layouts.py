"""Quantities that the layouts of several Fetch tasks share; `docs/tasks.md` has the whole layouts as tables."""

from typing import Any

import jax

from hgail_envs.layout import METRES, Layout, Quantity, flag, position

PER_ACTION = "m per action of 0.04 s"
"""Unit of velocities, which are multiplied by `hgail_envs.tasks.base.CONTROL_PERIOD` as the reference has it."""

GRIPPER = Layout(position("gripper position"), Quantity("gripper velocity", 3, PER_ACTION, "world"))
GAP = Quantity("gap between the fingers", 1, METRES, "hand")
HAND = Layout(GAP, flag("hand holds the cube"))
TARGET = position("target position")
"""The first quantity of every goal."""

_ARM = Quantity("gripper displacement", 3, "1 is about 0.033 m", "world")
ACTION = Layout(
    _ARM, Quantity("hand: positive opens, negative closes", 1, "1 drives the fingers to their stops", "hand")
)
ACTION_OF_ARM = Layout(_ARM, Quantity("hand: no effect, the fingers are blocked", 1, "", "hand"))


def target_of(goal: jax.Array) -> jax.Array:
    """Returns the positions, `[..., 3]`, of goals, `[..., goal_size]`."""
    return goal[..., : TARGET.size]


def of_object(name: str) -> Layout:
    """Returns the nine numbers of an object."""
    return Layout(
        position(f"{name} position less gripper position"),
        position(f"{name} position"),
        Quantity(f"{name} velocity", 3, PER_ACTION, "world"),
    )


def official(name: str) -> Layout:
    """Returns the layout of Gymnasium-Robotics' observation in its tasks with an object, without the goal."""
    return Layout(
        position("gripper position"),
        position(f"{name} position"),
        position(f"{name} position less gripper position"),
        Quantity("position of the right finger", 1, METRES, "hand"),
        Quantity("position of the left finger", 1, METRES, "hand"),
        Quantity(f"{name} rotation, Euler angle", 3, "rad", "world"),
        Quantity(f"{name} velocity less gripper velocity", 3, PER_ACTION, "world"),
        Quantity(f"{name} angular velocity", 3, "rad per action of 0.04 s", "world"),
        Quantity("gripper velocity", 3, PER_ACTION, "world"),
        Quantity("velocity of the right finger", 1, PER_ACTION, "hand"),
        Quantity("velocity of the left finger", 1, PER_ACTION, "hand"),
    )


def gripper_values(physics: Any) -> dict[str, jax.Array]:
    """Returns the values of `GRIPPER` in a `hgail_envs.tasks.base.ArmPhysics`."""
    return {"gripper position": physics.gripper_position, "gripper velocity": physics.gripper_velocity}

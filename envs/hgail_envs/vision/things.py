"""Things that stand around the table, in other places in each episode, and touch nothing."""

from typing import Any

import mujoco
import numpy as np

BOX, BALL, POST = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CYLINDER
# Beside and behind the robot for a camera in front of it, beyond the table for one at its side, and on the table's rim,
# where no cube starts; none is between a camera and the table.
_THINGS: tuple[tuple[Any, tuple[float, ...], tuple[float, ...], tuple[float, ...]], ...] = (
    (BOX, (0.15, 0.1, 0.2), (0.2, 1.6, 0.4), (0.3, 0.25, 0.3)),
    (POST, (0.06, 0.4, 0.0), (0.2, -0.1, 0.4), (0.3, 0.3, 0.3)),
    (BALL, (0.12, 0.0, 0.0), (1.0, -0.3, 0.3), (0.3, 0.3, 0.3)),
    (BOX, (0.08, 0.08, 0.3), (1.7, -0.3, 0.3), (0.3, 0.3, 0.3)),
    (BALL, (0.03, 0.0, 0.0), (1.3, 0.44, 0.43), (0.2, 0.02, 0.0)),
)
"""Type and size of each, the middle of where it may be, and half the width of that along each axis, metres."""
THING = "thing"
"""How their names begin."""
JOINTS = 3 * len(_THINGS)
"""Numbers that place them."""


def add_sliding_body(spec: mujoco.MjSpec, name: str, **geom: Any) -> None:
    """Adds a body to a scene's world whose slides along x, y and z are its joints, with a geom that touches nothing."""
    body = spec.worldbody.add_body(name=name)
    for axis in np.eye(3):
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    body.add_geom(contype=0, conaffinity=0, **geom)


def add_things(spec: mujoco.MjSpec, group: int) -> None:
    """Adds the things to a scene, of a group of geoms; their joints are the last."""
    for number, (kind, size, *_) in enumerate(_THINGS):
        add_sliding_body(spec, f"{THING} {number}", type=kind, size=size, rgba=(0.5, 0.5, 0.5, 1.0), group=group)


def places_of_things(draws: Any) -> Any:
    """Returns positions of the joints of the things, `[..., JOINTS]`, metres, for draws in [-1, 1] of that shape."""
    middle, half = (np.array([thing[part] for thing in _THINGS], np.float32).ravel() for part in (2, 3))
    return middle + half * draws

"""The parts of an arm by its tree of bodies: the joints of the arm, the palm, and the two sides of the hand."""

from typing import NamedTuple

import mujoco
import numpy as np

from hgail_envs.robots.arm_model import HAND_PREFIX
from hgail_envs.robots.derivation.given import Given

_LOOPS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))


class Parts(NamedTuple):
    """The parts of a model by the numbers of their bodies and joints."""

    joints: list[int]
    palm: int
    sides: tuple[set[int], set[int]]
    moving: list[int]
    """Joints of the hand."""


def find_parts(model: mujoco.MjModel, given: Given) -> Parts:
    """Finds them; a ValueError says that there is no hand, or that the sides of the hand have to be named.

    The arm is the chain of bodies with joints from the base to where it branches, into fingers. A chain that does not
    branch ends with a jaw, which closes on the body before it.
    """
    if given.hand is not None:
        _check_flange(model, given.flange)
    children = _children(model)
    arm, node = [], 0
    while len(children.get(node, [])) == 1:
        node = children[node][0]
        arm.append(node)
    roots = children.get(node, [])
    single = not roots
    if single:
        if len(arm) < 2:
            raise ValueError(f"{given.model} has {len(arm)} joints in a chain; an arm has more")
        roots = [arm.pop()]
        palm = int(model.body_parentid[roots[0]])
    else:
        palm = max(set.intersection(*(set(_ancestors(model, root)) for root in roots)), key=lambda b: _depth(model, b))
    sides = [_subtree(model, root) for root in roots]
    sides = [side for side in _merged(model, sides) if _has_shape(model, side)]
    joints = [joint for body in arm for joint in _joints_of(model, body)]
    if single:
        jaw = model.joint(int(model.body_jntadr[roots[0]]))
        if jaw.range[1] - jaw.range[0] > np.pi:  # more than a jaw turns
            raise ValueError(
                f"no hand: the joints are one chain, and the last, {jaw.name!r}, turns too far for a jaw; name a hand"
                " by --hand FILE and --flange NAME"
            )
        sides.insert(0, _subtree(model, palm) - sides[0])
    if len(sides) != 2 or given.pads:
        sides = _named_sides(model, sides, given, palm)
    names = [_side_name(model, side) for side in sides]
    if "left" in names[1] or "right" in names[0]:
        sides.reverse()
    if (model.jnt_type[joints] != mujoco.mjtJoint.mjJNT_HINGE).any():
        raise ValueError(f"{given.model}: the arm has a joint that is no hinge, which is not supported")
    moving = sorted(set(range(model.njnt)) - set(joints))
    return Parts(joints, palm, (sides[0], sides[1]), moving)


def _children(model: mujoco.MjModel) -> dict[int, list[int]]:
    """Returns the bodies with joints by the nearest body before them that has one, 0 for none."""
    children: dict[int, list[int]] = {}
    free = [body for body in range(model.nbody) if int(mujoco.mjtJoint.mjJNT_FREE) in _kinds(model, body)]
    if free:
        raise ValueError(f"the body {model.body(free[0]).name!r} is free; leave the arm alone in the file")
    for body in range(1, model.nbody):
        if model.body_jntnum[body]:
            before = [one for one in _ancestors(model, body)[1:] if one == 0 or model.body_jntnum[one]]
            children.setdefault(before[0], []).append(body)
    if not children:
        raise ValueError("the file has no joint; name the arm's own file, not a part that others include")
    if len(children[0]) != 1:
        roots = ", ".join(model.body(body).name for body in children[0])
        raise ValueError(f"the file must have one arm alone; its trees of joints begin at {roots}")
    _check_alone(model, children[0][0])
    return children


def _check_alone(model: mujoco.MjModel, first: int) -> None:
    """Checks that all that collides hangs on the same base as the first body with joints, or is the world's own."""
    base = _ancestors(model, first)[-2]
    for body in model.geom_bodyid[(model.geom_contype | model.geom_conaffinity) != 0].tolist():
        stranger = _ancestors(model, body)[-2] if body else base
        if stranger != base and model.body_mocapid[stranger] < 0:
            name = model.body(stranger).name
            raise ValueError(f"the body {name!r} is not the arm's; leave the arm alone in the file")


def _check_flange(model: mujoco.MjModel, flange: str) -> None:
    """Checks that no joint of the arm comes after the flange, a site or a body."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, flange)
    at = int(model.site_bodyid[site]) if site >= 0 else model.body(flange).id
    moving = [model.body(body).name for body in sorted(_subtree(model, at) - {at}) if model.body_jntnum[body]]
    after = [name for name in moving if not name.startswith(HAND_PREFIX)]
    if after:
        raise ValueError(f"the flange {flange!r} is not at the arm's end: after it comes {', '.join(after)}")


def _kinds(model: mujoco.MjModel, body: int) -> list[int]:
    return [int(model.jnt_type[joint]) for joint in _joints_of(model, body)]


def _joints_of(model: mujoco.MjModel, body: int) -> range:
    first = int(model.body_jntadr[body])
    return range(first, first + int(model.body_jntnum[body]))


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """Returns a body and those before it, the world last."""
    found = [int(body)]
    while found[-1]:
        found.append(int(model.body_parentid[found[-1]]))
    return found


def _depth(model: mujoco.MjModel, body: int) -> int:
    return len(_ancestors(model, body))


def _subtree(model: mujoco.MjModel, root: int) -> set[int]:
    return {body for body in range(model.nbody) if root in _ancestors(model, body)}


def _has_shape(model: mujoco.MjModel, side: set[int]) -> bool:
    return any(int(body) in side for body in model.geom_bodyid)


def _side_name(model: mujoco.MjModel, side: set[int]) -> str:
    return model.body(min(side)).name


def _merged(model: mujoco.MjModel, sides: list[set[int]]) -> list[set[int]]:
    """Joins the subtrees between which an equality closes a loop: they are one finger."""
    for equality in range(model.neq):
        closes = model.eq_type[equality] in _LOOPS
        of_bodies = model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_BODY
        first, second = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
        if closes and not of_bodies:
            first, second = int(model.site_bodyid[first]), int(model.site_bodyid[second])
        found = [side for side in sides if first in side or second in side]
        if closes and len(found) == 2:
            sides = [side for side in sides if side not in found] + [found[0] | found[1]]
    return sorted(sides, key=min)


def _named_sides(model: mujoco.MjModel, sides: list[set[int]], given: Given, palm: int) -> list[set[int]]:
    fingers = ", ".join(_side_name(model, side) for side in sides)
    if len(given.pads) != 2:
        raise ValueError(
            f"the hand at {model.body(palm).name!r} has {len(sides)} fingers ({fingers}); say by --pads which two"
            " bodies, or groups of bodies with commas between, meet"
        )
    named = []
    for names in given.pads:
        bodies = set()
        for name in names.split(","):
            if name not in [model.body(body).name for body in range(model.nbody)]:
                raise ValueError(f"--pads: there is no body {name!r}; the fingers are {fingers}")
            bodies.add(model.body(name).id)
        named.append(bodies)
    return named

"""A description of an arm, derived from its MJCF or URDF: what its bodies, joints and the shapes of its hand say.

The hand is moved through its range. Its pads are where the fingers' ends face each other at the width of the cube. The
arm stands at the table where it reaches the largest workspace.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from hgail_envs.robots.arm_model import attach_hand, complete, read_file
from hgail_envs.robots.derivation.given import Given
from hgail_envs.robots.derivation.limits import for_each, limit_of, torques
from hgail_envs.robots.derivation.motion import Motion, move_hand, moving_with, same_bodies, shapes_of
from hgail_envs.robots.derivation.pads import CUBE_WIDTH, ROOM, Pads, find_pads, quaternion_of, tool_of, turned
from hgail_envs.robots.derivation.placement import Place, find_place, reach_of
from hgail_envs.robots.derivation.tree import Parts, find_parts
from hgail_envs.robots.description import Description, Hand, Part
from hgail_envs.robots.grip import WEIGHT_PER_FORCE
from hgail_envs.robots.hand_boxes import cut_hull
from hgail_envs.scenes import explained

_SCALES = (1.0, 1.25, 1.6, 2.0, 2.5, 3.2, 4.0)  # metres of the scene to one of the robot; the least possible is taken
_TOP_SPEED = 3.14  # rad/s, where none is given
_LOWEST = 0.02  # metres of the scene, the part of a palm that can touch what is on the table
_ORDINARY = (0.03, 0.05, 0.03)  # metres of the scene, half the edges of a palm where no shape says more
_TO_ORDINARY = 0.1  # metres of the scene from the tool up to its middle
_LEAST_CHANGE = 0.004  # metres by which the gap of a hand changes at least
_LOAD = 0.15  # of the strongest joint's torque, that of the heaviest object at the start
_GRAVITY = 9.81  # m/s²
_HEAVIEST = 2.0  # kg, of the tasks' objects
_FASTEST_DRIVE = 70.0  # rad/s, of the hand's servo by itself: with 200 it shakes, and drops cubes
_FAINT, _LIGHTEST = 30.0, 0.02  # newtons where a model names no force; kg, less than which no object weighs


class Derived(NamedTuple):
    """A description, and what its numbers were derived from."""

    description: Description
    notes: tuple[str, ...]
    """Lines to be read by the user."""


class _Found(NamedTuple):
    model: mujoco.MjModel
    parts: Parts
    motion: Motion
    scale: float
    pads: Pads
    place: Place

    @property
    def forces(self) -> list[float | None]:
        """Most forces of the hand's driven joints, None where the model has no limit."""
        return [limit_of(self.model, joint) for joint in self.motion.joints]


def derive(given: Given) -> Derived:
    """Derives a description; a ValueError of one line says what has to be given, or why it cannot be."""
    spec = _read(given)
    with explained(str(given.model)):
        model = spec.compile()
    parts = find_parts(model, given)
    torque = torques(model, parts.joints, given)
    top_speed = for_each(given.top_speed or [_TOP_SPEED], parts.joints, "--top-speed")
    motion = move_hand(spec, model, parts)
    found = _Found(model, parts, motion, *_fit(model, parts, motion))
    description = _describe(given, found, torque, top_speed)
    return Derived(description, _notes(given, found, description))


def _read(given: Given) -> mujoco.MjSpec:
    with explained(str(given.model)):
        spec = read_file(given.model)
    if given.hand is not None:
        with explained(str(given.hand)):
            hand = read_file(given.hand)
        for element in (*hand.keys, *hand.lights, *hand.cameras, *hand.sensors):
            hand.delete(element)
        attach_hand(spec, hand, given.flange)
    for element in (*spec.keys, *spec.lights, *spec.cameras, *spec.sensors):
        spec.delete(element)
    complete(spec)
    return spec


def _fit(model: mujoco.MjModel, parts: Parts, motion: Motion) -> tuple[float, Pads, Place]:
    """Returns the least scale at which the hand takes the cube and the arm reaches the workspace."""
    fits, widest, least = [], 0.0, 0.0
    for scale in _SCALES:
        pads = find_pads(model, parts, motion, (CUBE_WIDTH + 2 * ROOM) / scale, scale)
        widest, least = max(widest, pads.gaps.max()), pads.gaps.min()
        if pads.gaps.max() >= (CUBE_WIDTH + ROOM) / scale and pads.gaps.min() < CUBE_WIDTH / scale - 0.002:
            fits.append((scale, pads))
    if np.ptp(pads.gaps) < _LEAST_CHANGE or not pads.facing:
        how = "pass each other" if not pads.facing else f"are always {1e3 * widest:.0f} mm apart"
        names = " and ".join(part.body for part in pads.parts)
        raise ValueError(f"the jaw does not close: {names} {how}; name the sides that meet by --pads")
    if not fits:
        raise ValueError(
            f"the hand opens from {1e3 * least:.0f} to {1e3 * widest:.0f} mm, and takes no cube of"
            f" {1e3 * CUBE_WIDTH / _SCALES[-1]:.0f} to {1e3 * CUBE_WIDTH:.0f} mm"
        )
    for scale, pads in fits:
        for one in turned(pads):
            place = find_place(model, parts.joints, parts.palm, *tool_of(one, scale), scale)
            if place is not None:
                return scale, one, place
    reach = reach_of(model, parts.joints, parts.palm, tool_of(fits[-1][1], fits[-1][0])[0])
    raise ValueError(
        f"the workspace is out of reach: it comes {reach:.2f} m far, and nowhere does it point downward in a box of"
        f" {1e3 * 0.3 / fits[-1][0]:.0f} mm on the table"
    )


def _describe(given: Given, found: _Found, torque: list[float], top_speed: list[float]) -> Description:
    model, parts, _, scale, pads, place = found
    tool, axes = tool_of(pads, scale)
    quat = quaternion_of(axes)
    hand, grip = _hand(found)
    payload = min(_HEAVIEST, WEIGHT_PER_FORCE * grip / _GRAVITY, _LOAD * max(torque) / _GRAVITY / place.distance)
    if payload < _LIGHTEST:
        raise ValueError(f"the hand grips with {grip:.2f} N, which holds no cube: the model's servos are too weak")
    closed = np.interp(0.0, pads.gaps[np.argsort(pads.gaps)], (pads.middles @ axes[:, 1])[np.argsort(pads.gaps)])
    meeting = float(closed - tool @ axes[:, 1])
    armature = float(np.median(model.dof_armature[model.jnt_dofadr[parts.joints]])) or 0.1 / scale**2
    return Description(
        model=str(given.model),
        hand_model="" if given.hand is None else str(given.hand),
        flange=given.flange,
        joints=[model.joint(joint).name for joint in parts.joints],
        torque=torque,
        top_speed=top_speed,
        home=place.home,
        reach=[place.distance, 0.0],
        tool=Part(model.body(parts.palm).name, tool, quat),
        palm=_palm(found, tool),
        right_pad=pads.parts[1],
        left_pad=pads.parts[0],
        hand=hand,
        armature=armature,
        payload=payload,
        clearance=Description.clearance / scale + pads.beyond,
        meeting=0.0 if abs(meeting) < 0.002 / scale else meeting,
        tilt_weight=place.tilt_weight,
        scale=scale,
    )


def _palm(found: _Found, tool: np.ndarray) -> Part:
    """Returns the box around the lowest part of the palm; an ordinary one if the palm has no shape, or is a jaw."""
    model, parts, motion, scale, pads, _ = found
    hand, name, quat, down = motion.model, model.body(parts.palm).name, quaternion_of(pads.axes), pads.axes[:, 0]
    palm, sides = same_bodies(model, hand, parts)
    shapes = [points for _, points in shapes_of(hand, motion.data[0], palm, moving_with(hand, palm, sides))]
    hulls = [points[ConvexHull(points, qhull_options="QJ").vertices] for points in shapes if len(points)]
    end = max((float((points @ down).max()) for points in hulls), default=0.0)
    lowest = [cut_hull(points, down, end - _LOWEST / scale) for points in hulls]
    if not any(map(len, lowest)):
        return Part(name, tool - down * _TO_ORDINARY / scale, quat, np.array(_ORDINARY) / scale)
    places = np.concatenate(lowest) @ pads.axes
    least, most = places.min(axis=0), places.max(axis=0)
    return Part(name, pads.axes @ (least + most) / 2.0, quat, (most - least) / 2.0)


def _hand(found: _Found) -> tuple[Hand, float]:
    """Returns the hand, and the force of its grip, N."""
    model, _, motion, scale, pads, _ = found
    order = np.argsort(pads.gaps)
    open_to = min(pads.gaps.max(), 2 * CUBE_WIDTH / scale)
    closed, opened = (
        [float(np.interp(gap, pads.gaps[order], column[order])) for column in motion.positions.T]
        for gap in (max(pads.gaps.min(), 0.0), open_to)
    )
    turns = model.jnt_type[motion.joints[0]] == mujoco.mjtJoint.mjJNT_HINGE
    lever = abs(open_to) / max(np.abs(np.subtract(opened, closed)).sum(), 1e-9)  # metres of the gap to a joint's unit
    force = min((force for force in found.forces if force), default=_FAINT * lever)
    stiffness = force / 0.1 if turns else force / (0.025 / scale)
    of_model = float(model.dof_armature[model.jnt_dofadr[motion.joints]].max())
    armature = max(0.005 / scale**2, of_model, stiffness / _FASTEST_DRIVE**2) if turns else 1.0
    damping = 2.0 * np.sqrt(stiffness * armature)
    hand = Hand(
        [model.joint(joint).name for joint in motion.joints], closed, opened, force, stiffness, float(damping), armature
    )
    return hand, force / lever


def _notes(given: Given, found: _Found, arm: Description) -> tuple[str, ...]:
    pads, place = found.pads, found.place
    x, y, _ = (_axis_name(axis) for axis in pads.axes.T)
    cube = 1e3 * CUBE_WIDTH / arm.scale
    lines = [
        f"arm: {len(arm.joints)} joints, {arm.joints[0]} to {arm.joints[-1]}",
        f"hand: palm {arm.tool.body}, pads on {arm.right_pad.body} and {arm.left_pad.body}, driven by"
        f" {', '.join(arm.hand.joints)}; it opens to {1e3 * pads.gaps.max():.0f} mm",
        f"axes in the palm's frame: the hand points along {x} and closes along {y}",
        f"scale {arm.scale:g}: its cube is {cube:.0f} mm wide and weighs {arm.payload:.2g} kg at most; the base stands"
        f" {place.distance:.2f} m from the middle of a workspace of {1e3 * 0.3 / arm.scale:.0f} mm",
    ]
    if place.tilt_weight < 0.1:
        lines.append("high above the table the hand tilts: the joints do not let it point downward there")
    if not given.top_speed:
        lines.append(f"top speed: {_TOP_SPEED} rad/s is a guess, MJCF has none; give the data sheet's by --top-speed")
    if not any(found.forces):
        lines.append(f"hand's force: {_FAINT:.0f} N is a guess, the model has none; change it in the file")
    return tuple(lines)


def _axis_name(axis: np.ndarray) -> str:
    largest = int(np.argmax(np.abs(axis)))
    if abs(axis[largest]) > 0.999:
        return f"{'+' if axis[largest] > 0 else '-'}{'xyz'[largest]}"
    return f"({', '.join(f'{value:.2f}' for value in axis)})"

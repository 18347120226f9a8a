"""The numbers of an arm, a TOML file, and the MjSpec of its model under the names that a scene knows."""

import dataclasses
import functools
import importlib.util
import tomllib
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from hgail_envs.robots.hand import PADS
from hgail_envs.scenes import VISUAL_GROUP, assets_directory

PREFIX = "arm/"
"""Of all names in the arm's own model."""

_HIDDEN = 4  # group that pictures leave out
_POSES = 50  # random ones, over which a joint's largest inertia is sought


@dataclasses.dataclass(frozen=True)
class Part:
    """A frame or a box that a body of the model carries; its x is where the hand points, and it closes along y."""

    body: str
    pos: Sequence[float]
    """Metres."""
    quat: Sequence[float]
    size: Sequence[float] = (0.01, 0.01, 0.01)
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

    package: str
    """Python package that has the model's files."""
    extra: str
    """Extra of this package that installs it."""
    model: str
    """MJCF of the arm, its base at the origin: a file of the package, or the text, in which `{package}` stands for the
    package's folder."""
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
    """Metres by which the arm's servos lead the gripper for a unit action."""


@functools.cache
def read_description(name: str) -> Description:
    """Reads `assets/robots/<name>.toml`."""
    content = tomllib.loads((assets_directory() / "robots" / f"{name}.toml").read_text())
    parts: dict[str, Any] = {part: Part(**content.pop(part)) for part in ("tool", "palm", "right_pad", "left_pad")}
    return Description(hand=Hand(**content.pop("hand")), **parts, **content)


def attach_arm(name: str, scene: mujoco.MjSpec, base: Sequence[float]) -> None:
    """Puts the arm into a scene, its base at `base`, `[3]`, metres: on servos of its own, and weightless.

    It touches nothing but with the geoms `palm`, `right_pad` and `left_pad`. They, sites on the pads of the same names
    and the site `grip` are added to its model, whose own names get a prefix. A ValueError says that the package with
    the model is not installed.
    """
    arm, spec = read_description(name), _read_model(name)
    _add_servos(spec, arm, _keep_inertias(name, spec))
    for geom in list(spec.geoms):
        if geom.contype or geom.conaffinity:
            spec.delete(geom)
        else:
            geom.group = VISUAL_GROUP
    scene.attach(spec, frame=scene.worldbody.add_frame(pos=base), prefix=PREFIX)
    scene.body(PREFIX + arm.tool.body).add_site(name="grip", pos=arm.tool.pos, quat=arm.tool.quat, group=_HIDDEN)
    for title in ("palm", *PADS):
        part: Part = getattr(arm, title)
        place = {"name": title, "pos": part.pos, "quat": part.quat, "group": _HIDDEN}
        body = scene.body(PREFIX + part.body)
        body.add_site(**place)
        body.add_geom(**place, type=mujoco.mjtGeom.mjGEOM_BOX, size=part.size, mass=0.0, contype=0, conaffinity=0)


def _read_model(name: str) -> mujoco.MjSpec:
    arm = read_description(name)
    package = importlib.util.find_spec(arm.package)
    if package is None or not package.submodule_search_locations:
        raise ValueError(f"robot {name!r} needs the package {arm.package}; pip install 'hgail-jax[{arm.extra}]'")
    folder = package.submodule_search_locations[0]
    spec = _read(arm.model, folder)
    if arm.hand_model:
        hand = _read(arm.hand_model, folder)
        hand.option.cone, hand.option.impratio = spec.option.cone, spec.option.impratio  # else MuJoCo warns
        spec.attach(hand, site=spec.site(arm.flange), prefix="hand/")
    for element in (*spec.keys, *spec.lights, *spec.cameras, *spec.sensors, *spec.actuators):
        spec.delete(element)
    spec.nuser_actuator = -1  # MuJoCo would warn that there are none
    return spec


def _read(model: str, folder: str) -> mujoco.MjSpec:
    if model.endswith(".xml"):
        return mujoco.MjSpec.from_file(f"{folder}/{model}")
    return mujoco.MjSpec.from_string(model.replace("{package}", folder))


@functools.cache
def _compiled(name: str) -> tuple[mujoco.MjModel, np.ndarray]:
    """Returns the model as it comes, and the largest inertia of each degree of freedom over many poses, `[nv]`."""
    model = _read_model(name).compile()
    data, rng, inertias = mujoco.MjData(model), np.random.default_rng(0), np.zeros((_POSES, model.nv, model.nv))
    for inertia in inertias:
        data.qpos[:] = rng.uniform(*model.jnt_range.T)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
    return model, inertias.max(axis=0).diagonal()


def _keep_inertias(name: str, spec: mujoco.MjSpec) -> dict[str, float]:
    """Writes down the inertias that follow from geoms; returns the largest of each joint by its name."""
    model, largest = _compiled(name)
    for body in spec.bodies[1:]:  # the first is the world
        of = model.body(body.name)
        body.explicitinertial, body.gravcomp = True, 1.0
        body.mass, body.ipos, body.iquat, body.inertia = of.mass[0], of.ipos, of.iquat, of.inertia
    return {model.joint(joint).name: largest[model.jnt_dofadr[joint]] for joint in range(model.njnt)}


def _add_servos(spec: mujoco.MjSpec, arm: Description, largest: dict[str, float]) -> None:
    """Puts a servo at each joint of the arm and of its hand, in this order, in place of damping and friction."""
    hand, turn = arm.hand, 2.0 * np.pi * arm.servo_frequency
    for name, torque in zip(arm.joints, arm.torque, strict=True):
        inertia = largest[name] + arm.armature
        _add_servo(spec.joint(name), spec, arm.armature, turn**2 * inertia, 2.0 * turn * inertia, torque)
    for name in hand.joints:
        _add_servo(spec.joint(name), spec, hand.armature, hand.stiffness, hand.damping, hand.force)


def _add_servo(
    joint: Any, spec: mujoco.MjSpec, armature: float, stiffness: float, damping: float, force: float
) -> None:
    joint.armature, joint.damping, joint.stiffness, joint.frictionloss = armature, np.zeros(3), np.zeros(3), 0.0
    servo = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=stiffness, kv=damping)
    servo.ctrllimited, servo.ctrlrange = True, joint.range
    servo.forcelimited, servo.forcerange = True, (-force, force)

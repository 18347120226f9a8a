"""The numbers of an arm, a TOML file, and the MjSpec of its model under the names that a scene knows."""

import dataclasses
import functools
import importlib.util
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from hgail_envs.robots.hand import PADS, rotation
from hgail_envs.scenes import VISUAL_GROUP, assets_directory, explained

PREFIX = "arm/"
"""Of all names in the arm's own model."""
HAND_PREFIX = "hand/"
"""Of those in the model of a hand that is attached."""

_HIDDEN = 4  # group that pictures leave out
_POSES = 50  # random ones, over which a joint's largest inertia is sought


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
    """Metres between the table and the lowest end of the pads, below which the gripper is not led. Servos that are at
    their limits let it sink farther."""
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
        raise ValueError(f"robot {name!r}: there is no file {name}; hgail robot makes one of an MJCF") from None


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
        raise ValueError(f"robot {name!r}: {path}: {str(error).replace('.__init__()', '')}") from None
    joints, hand = len(arm.joints), len(arm.hand.joints)
    for field, values, count in (
        *((field, getattr(arm, field), joints) for field in ("torque", "top_speed", "home")),
        *((f"hand.{field}", getattr(arm.hand, field), hand) for field in ("closed", "opened")),
    ):
        if len(values) != count:
            raise ValueError(f"robot {name!r}: {path}: {field} has {len(values)} numbers for {count} joints")
    return arm


def attach_arm(
    name: str, scene: mujoco.MjSpec, base: Sequence[float], stays_closed: bool = False, full: bool = False
) -> None:
    """Puts the arm into a scene, its base at `base`, `[3]`, metres: on servos of its own, and weightless.

    In a scene in which the hand `stays_closed` the gripper is where the pads meet.

    It touches nothing but with the geoms `palm`, `right_pad` and `left_pad`. They, sites on the pads of the same names
    and the site `grip` are added to its model, whose own names get a prefix. A `full` model keeps the maker's position
    servos, joints and colliding geoms, and touches with these, see `hgail_envs.robots.full_model`. A ValueError says
    that the package with the model is not installed, or that its model is none.
    """
    arm, spec = read_description(name), read_model(name, full)
    compiled = _compiled(name, text_of(name))
    _add_servos(spec, arm, compiled)
    _keep_inertias(spec, compiled[0])
    for geom in list(spec.geoms):
        if not (geom.contype or geom.conaffinity):
            geom.group = VISUAL_GROUP
        elif full:
            geom.group = _HIDDEN
        else:
            spec.delete(geom)
    if arm.scale != 1.0:
        enlarge(spec, arm.scale)
        scene.option.gravity *= arm.scale
    if full:
        scene.option.cone, scene.option.impratio = spec.option.cone, spec.option.impratio
    take_options(spec, scene)
    scene.attach(spec, frame=scene.worldbody.add_frame(pos=base), prefix=PREFIX)
    aside = rotation(arm.tool.quat)[:, 1] * (arm.meeting if stays_closed else 0.0)
    _add_part(scene, "grip", dataclasses.replace(arm.tool, pos=arm.tool.pos + aside), arm.scale)
    for title in ("palm", *PADS):
        part: Part = getattr(arm, title)
        place = _add_part(scene, title, part, arm.scale)
        geom = scene.body(PREFIX + part.body).add_geom(**place, size=arm.scale * np.asarray(part.size), mass=0.0)
        geom.type, geom.contype, geom.conaffinity = mujoco.mjtGeom.mjGEOM_BOX, 0, 0


def _add_part(scene: mujoco.MjSpec, title: str, part: Part, scale: float) -> dict[str, Any]:
    """Adds a part's site; returns its place."""
    place = {"name": title, "pos": scale * np.asarray(part.pos), "quat": part.quat, "group": _HIDDEN}
    scene.body(PREFIX + part.body).add_site(**place)
    return place


def enlarge(spec: mujoco.MjSpec, scale: float) -> None:
    """Enlarges a model whose bodies have explicit inertias. Masses and times stay, so that it moves alike.

    A torque, kg m²/s², and what turns grow by the square of `scale`, the force of a slide's servo by itself.
    """
    places = (*spec.bodies[1:], *spec.geoms, *spec.sites, *spec.joints, *spec.frames)
    for element in places:
        element.pos = scale * element.pos
    for body in spec.bodies[1:]:
        body.ipos, body.inertia = scale * body.ipos, scale**2 * body.inertia
    for sized in (*spec.geoms, *spec.sites):
        sized.size, sized.fromto = scale * sized.size, scale * sized.fromto
    for mesh in spec.meshes:
        mesh.scale = scale * mesh.scale
    for equality in spec.equalities:
        if equality.type in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD):
            equality.data[:6] = scale * equality.data[:6]  # two points
    slides = {joint.name for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_SLIDE}
    for joint in spec.joints:
        if joint.name in slides:
            joint.range, joint.ref, joint.springref = scale * joint.range, scale * joint.ref, scale * joint.springref
            joint.frictionloss *= scale
        else:
            joint.armature, joint.frictionloss = scale**2 * joint.armature, scale**2 * joint.frictionloss
            joint.damping, joint.stiffness = scale**2 * joint.damping, scale**2 * joint.stiffness
    for servo in spec.actuators:
        if servo.target in slides:
            servo.ctrlrange, servo.forcerange = scale * servo.ctrlrange, scale * servo.forcerange
        else:
            servo.forcerange = scale**2 * servo.forcerange
            servo.gainprm[0] *= scale**2
            servo.biasprm[1:3] *= scale**2


def read_model(name: str, actuators: bool = False) -> mujoco.MjSpec:
    """Returns the model of the arm with its hand, with or without the maker's position servos.

    A ValueError of one line says that it cannot be read.
    """
    arm = read_description(name)
    if arm.package:
        package = importlib.util.find_spec(arm.package)
        if package is None or not package.submodule_search_locations:
            raise ValueError(f"robot {name!r} needs the package {arm.package}; pip install 'hgail-jax[{arm.extra}]'")
        folder = package.submodule_search_locations[0]
    else:
        folder = str(Path(name).parent)
    with explained(f"of robot {name!r}"):
        spec = _read(arm.model, folder)
        if arm.hand_model:
            hand = _read(arm.hand_model, folder)
            contacts = hand.option.cone, hand.option.impratio
            attach_hand(spec, hand, arm.flange)
            spec.option.cone, spec.option.impratio = contacts  # what the hand holds depends on them
    others = [servo for servo in spec.actuators if not (actuators and servo.biasprm[1])]
    for element in (*spec.keys, *spec.lights, *spec.cameras, *spec.sensors, *others):
        spec.delete(element)
    spec.nuser_actuator = -1  # MuJoCo would warn that there are none
    complete(spec)
    return spec


def complete(spec: mujoco.MjSpec) -> None:
    """Names bodies and joints that have no name, and limits hinges that have no limits to a turn on either side."""
    turn = 360.0 if spec.compiler.degree else 2.0 * np.pi
    for kind, elements in (("body", spec.bodies[1:]), ("joint", spec.joints)):
        for number, element in enumerate(elements):
            element.name = element.name or f"{kind}-{number}"
    for joint in spec.joints:
        unlimited = joint.limited == mujoco.mjtLimited.mjLIMITED_FALSE or not joint.range.any()
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE and unlimited:
            joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, [-turn, turn]


def _read(model: str, folder: str) -> mujoco.MjSpec:
    if model.endswith(".xml"):
        return mujoco.MjSpec.from_file(f"{folder}/{model}")
    return mujoco.MjSpec.from_string(model.replace("{package}", folder))


def take_options(spec: mujoco.MjSpec, other: mujoco.MjSpec) -> None:
    """Gives a model the options of the one that it will be attached to, or MuJoCo would warn of those that differ."""
    for name in dir(other.option):
        if not name.startswith("_"):
            setattr(spec.option, name, getattr(other.option, name))


def attach_hand(spec: mujoco.MjSpec, hand: mujoco.MjSpec, flange: str) -> None:
    """Attaches a hand at a site or a body of an arm; a ValueError if there is none of this name."""
    take_options(hand, spec)
    sites = [site.name for site in spec.sites]
    bodies = [body.name for body in spec.bodies[1:]]
    if flange in sites:
        spec.attach(hand, site=spec.site(flange), prefix=HAND_PREFIX)
    elif flange in bodies:
        spec.attach(hand, frame=spec.body(flange).add_frame(), prefix=HAND_PREFIX)
    else:
        there = ", ".join(filter(None, (*sites, *bodies)))
        raise ValueError(f"the arm has no site or body {flange!r} as its flange; it has {there}")


@functools.cache
def _compiled(name: str, text: str) -> tuple[mujoco.MjModel, np.ndarray]:
    """Returns the model as it comes, and the largest inertia of each degree of freedom over many poses, `[nv]`."""
    del text  # the cache's
    model = read_model(name).compile()
    data, rng, inertias = mujoco.MjData(model), np.random.default_rng(0), np.zeros((_POSES, model.nv, model.nv))
    for inertia in inertias:
        data.qpos[:] = rng.uniform(*model.jnt_range.T)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
    return model, inertias.max(axis=0).diagonal()


def _keep_inertias(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Writes down the inertias that follow from geoms."""
    for body in spec.bodies[1:]:  # the first is the world
        of = model.body(body.name)
        body.explicitinertial, body.gravcomp = True, 1.0
        body.mass, body.ipos, body.iquat, body.inertia = of.mass[0], of.ipos, of.iquat, of.inertia
        body.fullinertia = np.full(6, np.nan)  # the same in another form, which excludes this one


def _add_servos(spec: mujoco.MjSpec, arm: Description, compiled: tuple[mujoco.MjModel, np.ndarray]) -> None:
    """Puts a servo at each joint of the arm and of its hand, in this order, in place of damping and friction.

    Joints of the arm that have one, and a hand that has one, keep it; drives of the hand become as stiff as described.
    """
    (model, largest), hand, turn = compiled, arm.hand, 2.0 * np.pi * arm.servo_frequency
    driven = {servo.target: servo for servo in spec.actuators}
    for name, torque, speed in zip(arm.joints, arm.torque, arm.top_speed, strict=True):
        if name in driven:
            joint, servo = spec.joint(name), driven[name]
            if joint.damping[0] * speed > torque:  # not the drive's, which would never get there: the servo's own
                servo.biasprm[2] -= joint.damping[0]
                joint.damping = np.zeros(3)
            continue
        inertia = largest[model.jnt_dofadr[model.joint(name).id]] + arm.armature
        servo = _add_servo(spec, model, name, arm.armature)
        servo.set_to_position(kp=turn**2 * inertia, kv=2.0 * turn * inertia)
        servo.forcerange = (-torque, torque)
    for name in hand.joints:
        if name in driven:
            factor = hand.stiffness / -driven[name].biasprm[1]
            driven[name].gainprm[0] *= factor
            driven[name].biasprm[1] *= factor
    for name in hand.joints if driven.keys() <= set(arm.joints) else ():
        servo = _add_servo(spec, model, name, hand.armature)
        servo.set_to_position(kp=hand.stiffness, kv=hand.damping)
        servo.forcerange = (-hand.force, hand.force)


def _add_servo(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str, armature: float) -> Any:
    joint = spec.joint(name)
    joint.armature, joint.damping, joint.stiffness, joint.frictionloss = armature, np.zeros(3), np.zeros(3), 0.0
    servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.ctrllimited = servo.forcelimited = True
    servo.ctrlrange = model.joint(name).range  # radians, whatever the file's unit
    return servo

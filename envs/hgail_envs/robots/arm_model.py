"""The MjSpec of an arm, read from its MJCF or URDF: on servos of its own and under the names that a scene knows."""

import dataclasses
import functools
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from hgail_envs.robots.description import Description, Part, read_description, text_of
from hgail_envs.robots.hand import PADS, rotation
from hgail_envs.scenes import VISUAL_GROUP, explained

PREFIX = "arm/"
"""Of all names in the arm's own model."""
HAND_PREFIX = "hand/"
"""Of those in the model of a hand that is attached."""

HIDDEN = 4
"""Group of geoms that pictures leave out."""
_CONTACT = ("friction", "solref", "solimp", "margin")  # fields of a geom
_POSES = 50  # random ones, over which a joint's largest inertia is sought


def attach_arm(
    name: str, scene: mujoco.MjSpec, base: Sequence[float], stays_closed: bool = False, full: bool = False
) -> None:
    """Puts the arm into a scene, its base at `base`, `[3]`, metres: on servos of its own, and weightless.

    The scene's contacts get the friction cone of the arm's model.

    In a scene in which the hand `stays_closed` the gripper is where the pads meet.

    It touches with the geoms `palm`, `right_pad` and `left_pad`, and with those of `hgail_envs.robots.hand_boxes`. The
    first three, sites on the pads of the same names and the site `grip` are added to its model, whose own names get a
    prefix. Pads have the contact parameters of the model's where those have priority. A `full` model keeps the maker's
    position servos, joints and colliding geoms, and touches with these, see `hgail_envs.robots.full_model`. A
    ValueError says that the package with the model is not installed, or that its model is none.
    """
    arm, spec = read_description(name), read_model(name, full)
    compiled = _compiled(name, text_of(name))
    _add_servos(spec, arm, compiled)
    _keep_inertias(spec, compiled[0])
    contacts = {pad: _contact_by_priority(spec.body(getattr(arm, pad).body)) for pad in PADS}
    shown = {geom.parent.name for geom in spec.geoms if not (geom.contype or geom.conaffinity)}
    for geom in list(spec.geoms):
        touches = geom.contype or geom.conaffinity
        if touches and full:
            geom.group = HIDDEN
        elif touches and geom.parent.name in shown:
            spec.delete(geom)
        else:  # pictures show what touches of a body that has nothing else, as in a URDF
            geom.group, geom.contype, geom.conaffinity = VISUAL_GROUP, 0, 0
    if arm.scale != 1.0:
        enlarge(spec, arm.scale)
        scene.option.gravity *= arm.scale
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
        for field, value in contacts.get(title, {}).items():
            setattr(geom, field, value)


def _contact_by_priority(body: mujoco.MjsBody) -> dict[str, Any]:
    """Returns fields of a geom that touches as a body does: means over its geoms of the highest priority, if any.

    What lies on all of them touches each. So both ends of the impedance are raised until compliances, (1 - impedance) /
    impedance, are divided by their number.
    """
    geoms = [geom for geom in body.geoms if geom.priority > 0 and (geom.contype or geom.conaffinity)]
    if not geoms:
        return {}
    highest = max(geom.priority for geom in geoms)
    geoms = [geom for geom in geoms if geom.priority == highest]
    means = {name: np.mean([getattr(geom, name) for geom in geoms], axis=0) for name in _CONTACT}
    impedance = means["solimp"][:2]
    means["solimp"][:2] = len(geoms) * impedance / (1.0 + (len(geoms) - 1) * impedance)
    return means | {"priority": highest, "condim": max(geom.condim for geom in geoms)}


def touch_by_priority(scene: mujoco.MjSpec) -> None:
    """Lets a pad with priority touch by its own numbers alone, as by MuJoCo's rule without the scene's pairs.

    Without priority the scene's pairs keep theirs, which are those of the Fetch's pads.
    """
    for pad in [scene.geom(name) for name in PADS]:
        of_pad = [pair for pair in scene.pairs if pad.priority > 0 and pad.name in (pair.geomname1, pair.geomname2)]
        for pair in of_pad:
            slide, spin, roll = pad.friction
            pair.friction, pair.condim, pair.margin = [slide, slide, spin, roll, roll], pad.condim, pad.margin
            pair.solref, pair.solimp = pad.solref, pad.solimp


def _add_part(scene: mujoco.MjSpec, title: str, part: Part, scale: float) -> dict[str, Any]:
    """Adds a part's site; returns its place."""
    place = {"name": title, "pos": scale * np.asarray(part.pos), "quat": part.quat, "group": HIDDEN}
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
    # A mocap body that pulls the hand by a weld is another way to move the arm, which has servos here.
    mocaps = [body for body in spec.bodies[1:] if body.mocap]
    pulled = {body.name for body in mocaps}
    welds = [equality for equality in spec.equalities if pulled & {equality.name1, equality.name2}]
    for element in (*spec.keys, *spec.lights, *spec.cameras, *spec.sensors, *others, *welds, *mocaps):
        spec.delete(element)
    for site in spec.sites:
        site.group = HIDDEN  # pictures would show the file's marks over the arm
    spec.nuser_actuator = -1  # MuJoCo would warn that there are none
    complete(spec)
    _check_names(name, arm, spec)
    return spec


def _check_names(name: str, arm: Description, spec: mujoco.MjSpec) -> None:
    """Raises a ValueError for the first joint or body of a description that its model does not have."""
    bodies = [getattr(arm, part).body for part in ("tool", "palm", *PADS)]
    for kind, elements, named in (
        ("joint", spec.joints, (*arm.joints, *arm.hand.joints)),
        ("body", spec.bodies[1:], bodies),
    ):
        there = [element.name for element in elements]
        for one in named:
            if one not in there:
                raise ValueError(f"robot {name!r}: its model has no {kind} {one!r}; it has {', '.join(there)}")


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


def read_file(path: Path) -> mujoco.MjSpec:
    """Reads an MJCF, or a URDF, whose bodies have no names in a MjSpec before it is compiled."""
    spec = mujoco.MjSpec.from_file(str(path))
    if path.suffix != ".urdf":
        return spec
    spec.compile()
    compiled = mujoco.MjSpec.from_string(spec.to_xml())
    compiled.modelfiledir = str(path.parent)
    for geom in compiled.worldbody.geoms:  # the base, which would touch the link on it: they overlap in most files
        geom.contype, geom.conaffinity = 0, 0
    return compiled


def _read(model: str, folder: str) -> mujoco.MjSpec:
    if model.endswith((".xml", ".urdf")):
        return read_file(Path(folder) / model)
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

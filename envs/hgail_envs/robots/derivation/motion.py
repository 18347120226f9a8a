"""A hand moved through its range, without the arm, gravity and contacts."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from hgail_envs.robots.derivation.limits import share_of
from hgail_envs.robots.derivation.tree import Parts

_STEPS = 17  # of the hand's range
_SETTLING = 300  # physics steps at each
_ROUND = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
_SQUARE = (int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_ELLIPSOID))


class Motion(NamedTuple):
    """The hand from closed to open."""

    model: mujoco.MjModel
    data: list[mujoco.MjData]
    joints: list[int]
    positions: np.ndarray
    """`[steps, joints]` of the driven joints."""


def move_hand(spec: mujoco.MjSpec, model: mujoco.MjModel, parts: Parts) -> Motion:
    """Moves the hand by servos at its driven joints, those of several in the directions that open it the most."""
    driven = _driven(model, parts)
    names = [model.joint(joint).name for joint in driven]
    for joint in driven:
        if not model.jnt_limited[joint]:
            raise ValueError(f"the hand's joint {model.joint(joint).name!r} has no range")
    hand, ranges = _hand_alone(spec, model, parts, names), model.jnt_range[driven]
    here = [hand.joint(name).id for name in names]
    palm, sides = same_bodies(model, hand, parts)

    def moved(signs: Sequence[int]) -> tuple[list[mujoco.MjData], np.ndarray]:
        data, snapshots, controls = mujoco.MjData(hand), [], []
        for share in np.linspace(0.0, 1.0, _STEPS):
            shares = np.where(np.array(signs) > 0, share, 1.0 - share)
            data.ctrl[:] = ranges[:, 0] + shares * (ranges[:, 1] - ranges[:, 0])
            mujoco.mj_step(hand, data, nstep=_SETTLING)
            mujoco.mj_forward(hand, data)
            snapshot = mujoco.MjData(hand)
            mujoco.mj_copyData(snapshot, hand, data)
            snapshots.append(snapshot)
            controls.append(data.qpos[hand.jnt_qposadr[here]].copy())
        return snapshots, np.array(controls)

    tried = [moved((1, *rest)) for rest in itertools.product((1, -1), repeat=len(driven) - 1)]
    widths = [[_width(hand, data, palm, sides) for data in snapshots] for snapshots, _ in tried]
    best = int(np.argmax([abs(width[-1] - width[0]) for width in widths]))
    (snapshots, positions), width = tried[best], widths[best]
    if width[-1] < width[0]:
        snapshots, positions = snapshots[::-1], positions[::-1]
    return Motion(hand, snapshots, driven, positions)


def _driven(model: mujoco.MjModel, parts: Parts) -> list[int]:
    """Returns the hand's joints that actuators drive; of a hand without, those that follow no other."""
    found = [joint for joint in parts.moving if any(share_of(model, actuator, joint) for actuator in range(model.nu))]
    if found:
        return found
    of_joints = [e for e in range(model.neq) if model.eq_type[e] == mujoco.mjtEq.mjEQ_JOINT]
    following = {int(model.eq_obj1id[equality]) for equality in of_joints}
    return [joint for joint in parts.moving if joint not in following] or parts.moving


def _hand_alone(spec: mujoco.MjSpec, model: mujoco.MjModel, parts: Parts, driven: list[str]) -> mujoco.MjModel:
    """Returns the model with the arm at rest, without gravity and contacts, and servos at the hand's driven joints."""
    alone = spec.copy()
    for actuator in list(alone.actuators):
        alone.delete(actuator)
    arm = {model.joint(joint).name for joint in parts.joints}
    for joint in list(alone.joints):
        if joint.name in arm:
            alone.delete(joint)
    for name in driven:
        joint = alone.joint(name)
        joint.armature, joint.damping, joint.frictionloss = 0.01, np.zeros(3), 0.0
        servo = alone.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=100.0, kv=3.0)
    alone.nuser_actuator = -1
    option = alone.option
    option.gravity, option.timestep, option.integrator = np.zeros(3), 0.002, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return alone.compile()


def same_bodies(model: mujoco.MjModel, hand: mujoco.MjModel, parts: Parts) -> tuple[int, list[set[int]]]:
    """Returns the palm and the sides by their numbers in another model."""
    number = {body: hand.body(model.body(body).name).id for body in range(1, model.nbody)}
    return number[parts.palm], [{number[body] for body in side} for side in parts.sides]


def _width(hand: mujoco.MjModel, data: mujoco.MjData, palm: int, sides: list[set[int]]) -> float:
    """Returns the least distance between points of the ends of the fingers, metres."""
    ends = []
    for side in sides:
        points, _ = points_of(hand, data, palm, side)
        far = np.argsort(np.linalg.norm(points, axis=1))[-max(8, len(points) // 10) :]
        ends.append(points[far][:: max(1, len(far) // 200)])
    return float(np.linalg.norm(ends[0][:, None] - ends[1][None], axis=-1).min())


def moving_with(model: mujoco.MjModel, palm: int, sides: list[set[int]]) -> set[int]:
    """Returns the palm and the bodies that are fixed to it, but for those of the sides; none if it is a side's."""
    found = {palm}.difference(*sides)
    for body in range(palm + 1, model.nbody):  # parents come first
        if int(model.body_parentid[body]) in found and not model.body_jntnum[body]:
            found |= {body}.difference(*sides)
    return found


def shapes_of(model: mujoco.MjModel, data: mujoco.MjData, palm: int, bodies: set[int]) -> list[tuple[int, np.ndarray]]:
    """Returns the body of each shape of bodies, and points on it, `[points, 3]`, in the palm's frame."""
    geoms = [geom for geom in range(model.ngeom) if int(model.geom_bodyid[geom]) in bodies]
    colliding = [geom for geom in geoms if model.geom_contype[geom] or model.geom_conaffinity[geom]]
    found = []
    for geom in colliding or geoms:
        world = data.geom_xpos[geom] + _surface(model, geom) @ data.geom_xmat[geom].reshape(3, 3).T
        points = (world - data.xpos[palm]) @ data.xmat[palm].reshape(3, 3)
        found.append((int(model.geom_bodyid[geom]), points))
    return found


def points_of(model: mujoco.MjModel, data: mujoco.MjData, palm: int, side: set[int]) -> tuple[np.ndarray, np.ndarray]:
    """Returns points on the shapes of bodies, `[points, 3]`, in the palm's frame, and the body of each."""
    found, bodies = [np.zeros((0, 3))], [np.zeros(0, int)]
    for body, points in shapes_of(model, data, palm, side):
        found.append(points)
        bodies.append(np.full(len(points), body))
    return np.concatenate(found), np.concatenate(bodies)


def _surface(model: mujoco.MjModel, geom: int) -> np.ndarray:
    kind, size = model.geom_type[geom], model.geom_size[geom]
    grid = np.linspace(-1.0, 1.0, 9)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        return np.array(model.mesh_vert[first : first + model.mesh_vertnum[mesh]], float)
    if kind in _SQUARE:
        return np.stack(np.meshgrid(grid, grid, grid), axis=-1).reshape(-1, 3) * size
    if kind in _ROUND:
        angles, along = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 17), grid * size[1])
        points = np.stack([size[0] * np.cos(angles), size[0] * np.sin(angles), along], axis=-1).reshape(-1, 3)
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            points = np.concatenate([points, [[0.0, 0.0, way * (size[1] + size[0])] for way in (-1.0, 1.0)]])
        return points
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        directions = np.random.default_rng(0).normal(size=(60, 3))
        return size[0] * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.zeros((0, 3))

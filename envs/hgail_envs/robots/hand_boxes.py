"""Boxes for what can touch an object beside the pads: the fingers' whole shapes, and the links that carry them."""

import functools
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from hgail_envs.robots.arm_model import HIDDEN, PREFIX, attach_arm
from hgail_envs.robots.description import read_description, text_of
from hgail_envs.robots.grip import tabulate_hand
from hgail_envs.robots.hand import PADS

_WIDTH = 0.05  # metres of the scene of an object on the table, along each edge
_LEAST = 0.005  # metres of the scene by which a shape must reach below its top, and of its thickness
_BEYOND = 0.002  # metres of the scene by which a shape must be larger than the pad
_RECESS = 0.002  # metres of the scene from a pad's face to a box: the pad alone holds what the hand closes on
_FLAT = 1e-5  # metres, the thickness of a shape that is none
_VERTICES = 128  # of a mesh's convex hull at most
_ROUND = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
_CORNERS = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)


class HandBox(NamedTuple):
    """A box that a body of the hand carries, in its frame and in the scene's metres."""

    body: str
    pos: np.ndarray
    quat: np.ndarray
    size: np.ndarray
    """Half its edges."""


def add_hand_boxes(scene: mujoco.MjSpec, name: str) -> None:
    """Lets the hand of an arm that is in a scene touch with boxes, too: the bodies of free joints that its pads touch.

    The friction and the solver's numbers are those of the scene's pairs with the pads.
    """
    objects = {}
    for pair in scene.pairs:
        if PADS[0] in (pair.geomname1, pair.geomname2):
            other = pair.geomname2 if pair.geomname1 == PADS[0] else pair.geomname1
            if _is_free(scene.geom(other).parent):
                objects[other] = pair
    for number, box in enumerate(hand_boxes(name) if objects else ()):
        geom = scene.body(box.body).add_geom(name=f"hand_{number}", pos=box.pos, quat=box.quat, size=box.size, mass=0.0)
        geom.type, geom.contype, geom.conaffinity, geom.group = mujoco.mjtGeom.mjGEOM_BOX, 0, 0, HIDDEN
        for other, like in objects.items():
            pair = scene.add_pair(geomname1=geom.name, geomname2=other, condim=3, margin=like.margin)
            pair.friction, pair.solref, pair.solimp = like.friction, like.solref, like.solimp


def _is_free(body: mujoco.MjsBody) -> bool:
    return any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in body.joints)


def hand_boxes(name: str) -> list[HandBox]:
    """Returns the boxes of an arm's hand; `name` is that of a description, see `read_description`.

    Of the colliding shapes of each body of the hand, which is as open as an object is wide, the convex hull is taken,
    and of it what is lower than the top of an object on the table, and not in front of the pad on its side. Its lower
    and its upper half have a box each, along the tool's axes and as large as the half. What is no larger than the pad
    has none, nor has the palm, and nor has a model without colliding geoms.
    """
    return _found(name, text_of(name))


class _Hand(NamedTuple):
    """A full model of an arm, posed; points are in the frame of its tool."""

    model: mujoco.MjModel
    data: mujoco.MjData

    def points(self, geom: int) -> np.ndarray:
        """Returns points whose convex hull is a geom, nearly, `[points, 3]`."""
        world = _surface(self.model, geom) @ _axes(self.data.geom_xmat[geom]).T + self.data.geom_xpos[geom]
        return (world - self.data.site("grip").xpos) @ self.frame

    @property
    def frame(self) -> np.ndarray:
        """The tool's axes as columns, in the world."""
        return _axes(self.data.site("grip").xmat)


@functools.cache
def _found(name: str, text: str) -> list[HandBox]:
    del text  # the cache's
    arm, hand = read_description(name), _around_object(name)
    pads = [hand.points(hand.model.geom(pad).id) for pad in PADS]
    middle = np.mean([pad[:, 1].mean() for pad in pads])
    top = max(pad[:, 0].max() for pad in pads) + arm.scale * arm.clearance - _WIDTH
    colliding, boxes = (hand.model.geom_contype | hand.model.geom_conaffinity) != 0, []
    for body in _bodies_beside_the_palm(hand.model, arm.palm.body, [getattr(arm, pad).body for pad in PADS]):
        geoms = np.flatnonzero((hand.model.geom_bodyid == body) & colliding).tolist()
        shapes = [cut_hull(hand.points(geom), np.array([1.0, 0.0, 0.0]), top) for geom in geoms]
        if not any(map(len, shapes)):
            continue
        side = float(np.sign(np.concatenate(shapes)[:, 1].mean() - middle))
        pad = pads[0 if side > 0 else 1]
        face = float((side * pad[:, 1]).min()) + _RECESS
        points = np.concatenate([cut_hull(shape, np.array([0.0, side, 0.0]), face) for shape in shapes])
        larger = (points < pad.min(axis=0) - _BEYOND) | (points > pad.max(axis=0) + _BEYOND)
        if larger.any() and np.ptp(points, axis=0).min() > _LEAST:
            middle_height = 0.5 * (points[:, 0].min() + points[:, 0].max())
            for way in (1.0, -1.0):
                half = cut_hull(points, np.array([way, 0.0, 0.0]), way * middle_height)
                boxes.append(_around(hand, body, half))
    return boxes


def _around_object(name: str) -> _Hand:
    """Returns an arm at home whose hand is as open as an object is wide."""
    arm, spec, table = read_description(name), mujoco.MjSpec(), tabulate_hand(name)
    attach_arm(name, spec, [0.0, 0.0, 0.0], full=True)
    for mesh in spec.meshes:
        mesh.maxhullvert = _VERTICES
    model = spec.compile()
    data, joints = mujoco.MjData(model), [model.joint(PREFIX + joint).id for joint in arm.joints]
    of_arm = model.jnt_qposadr[joints]
    data.qpos[of_arm] = arm.home
    of_hand = np.setdiff1d(np.arange(model.nq), of_arm)
    data.qpos[of_hand] = [np.interp(_WIDTH, table.gaps, column) for column in table.openings.T]
    mujoco.mj_kinematics(model, data)
    return _Hand(model, data)


def _bodies_beside_the_palm(model: mujoco.MjModel, palm: str, of_pads: list[str]) -> list[int]:
    """Returns the bodies that the palm carries, and itself if it carries a pad: else its box is there."""
    first = model.body(PREFIX + palm).id
    carried = {first}
    for body in range(model.nbody):  # parents come first
        if int(model.body_parentid[body]) in carried:
            carried.add(body)
    return sorted(carried if palm in of_pads else carried - {first})


def cut_hull(points: np.ndarray, normal: np.ndarray, least: float) -> np.ndarray:
    """Cuts a convex hull of points, `[points, 3]`, along a plane: those above it, and where edges pass through it."""
    heights = points @ normal - least
    inside, outside = points[heights >= 0.0], points[heights < 0.0]
    up, down = heights[heights >= 0.0][:, None, None], heights[heights < 0.0][None, :, None]
    crossing = (outside[None] * up - inside[:, None] * down) / (up - down)
    points = np.concatenate([inside, crossing.reshape(-1, 3)])
    if len(points) < 4 or np.ptp(points, axis=0).min() < _FLAT:
        return points[:0]
    return points[ConvexHull(points, qhull_options="QJ").vertices]


def _surface(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Returns points whose convex hull is a geom, nearly, `[points, 3]`, in its frame."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        graph = model.mesh_graph[model.mesh_graphadr[mesh] :]
        count = graph[0]
        return model.mesh_vert[model.mesh_vertadr[mesh] + graph[2 + count : 2 + 2 * count]].astype(float)
    if kind in _ROUND:
        ring = size[0] * np.stack([np.cos(_ANGLES), np.sin(_ANGLES), np.zeros_like(_ANGLES)], axis=1)
        up, cap = np.array([0.0, 0.0, 1.0]), size[1] + (size[0] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0)
        return np.concatenate([ring - size[1] * up, ring + size[1] * up, [-cap * up, cap * up]])
    return _CORNERS * (size[0] if kind == mujoco.mjtGeom.mjGEOM_SPHERE else size)


def _around(hand: _Hand, body: int, points: np.ndarray) -> HandBox:
    """Returns the box around points, `[points, 3]`, along the tool's axes."""
    low, high = points.min(axis=0), points.max(axis=0)
    to_body, quat = _axes(hand.data.xmat[body]).T, np.zeros(4)
    mujoco.mju_mat2Quat(quat, (to_body @ hand.frame).ravel())
    place = hand.data.site("grip").xpos + hand.frame @ (0.5 * (low + high)) - hand.data.xpos[body]
    return HandBox(hand.model.body(body).name, to_body @ place, quat, 0.5 * (high - low))


def _axes(matrix: np.ndarray) -> np.ndarray:
    return matrix.reshape(3, 3)

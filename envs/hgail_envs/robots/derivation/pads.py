"""The pads of a hand: boxes where the ends of its fingers face each other at the width of the cube."""

import dataclasses
from typing import NamedTuple

import mujoco
import numpy as np

from hgail_envs.robots.derivation.motion import Motion, points_of, same_bodies
from hgail_envs.robots.derivation.tree import Parts
from hgail_envs.robots.description import Part

CUBE_WIDTH = 0.05
"""Metres of the scene along each edge of the tasks' cube."""
ROOM = 0.006
"""Metres of the scene on each side of the cube in an open hand."""

_ABOVE_ENDS = 0.0185  # metres of the scene from the pads' ends to the point between them
_PAD_HEIGHT, _PAD_WIDTH, _PAD_DEPTH = 0.018, 0.0125, 0.0075  # metres of the scene, half of the largest pad
_TIP = 0.02  # metres of the fingers' ends by whose inner faces the pads are found
_FACE = 0.003  # metres within which points belong to a face
_OVERLAP = 0.0005  # metres, half of the least width over which faces look at each other
_NARROWEST = 0.003  # metres, half of the narrowest pad


class Pads(NamedTuple):
    """The pads at each step of a motion, and the tool, in the palm's frame."""

    axes: np.ndarray
    """`[3, 3]`; x is where the hand points, and it closes along y."""
    gaps: np.ndarray
    middles: np.ndarray
    parts: tuple[Part, Part]
    facing: bool
    """Whether the faces of the pads overlap, so that they can hold something."""
    beyond: float
    """Metres by which the fingers end beyond the pads."""


def find_pads(model: mujoco.MjModel, parts: Parts, motion: Motion, width: float, scale: float) -> Pads:
    """Returns the pads that face each other at a width, metres."""
    pads = _pads_at(model, parts, motion, len(motion.data) // 3, scale)
    step = int(np.clip(np.argmin(np.abs(pads.gaps - width)), 1, len(motion.data) - 2))
    return _pads_at(model, parts, motion, step, scale)


def _pads_at(model: mujoco.MjModel, parts: Parts, motion: Motion, step: int, scale: float) -> Pads:
    hand, data, then = motion.model, motion.data[step], motion.data[step + 1]
    palm, sides = same_bodies(model, hand, parts)
    clouds = [points_of(hand, data, palm, side) for side in sides]
    ends = [np.argsort(np.linalg.norm(points, axis=1))[-max(8, len(points) // 20) :] for points, _ in clouds]
    moves = [
        (points_of(hand, then, palm, side)[0][end] - points[end]).mean(axis=0)
        for side, (points, _), end in zip(sides, clouds, ends, strict=True)
    ]
    tips = [points[end].mean(axis=0) for (points, _), end in zip(clouds, ends, strict=True)]
    axes = _axes(moves[1] - moves[0], (tips[0] + tips[1]) / 2, _last_axis(model, parts))
    faces = [_face(*cloud, axes, sign, scale) for cloud, sign in zip(clouds, (1.0, -1.0), strict=True)]
    depth = min(face.end for face in faces)
    height = min(_PAD_HEIGHT / scale, *(0.5 * face.length for face in faces))
    least, most = max(face.sides[0] for face in faces), min(face.sides[1] for face in faces)
    lateral, half = (least + most) / 2, (most - least) / 2
    size = np.array([height, _PAD_DEPTH / scale, np.clip(half, _NARROWEST, _PAD_WIDTH / scale)])
    centres = [
        axes @ np.array([depth - height, face.inner - sign * size[1], lateral])
        for face, sign in zip(faces, (1.0, -1.0), strict=True)
    ]
    boxes = tuple(
        _part(hand, data, palm, face.body, centre, axes, size) for face, centre in zip(faces, centres, strict=True)
    )
    gaps, middles = [], []
    for snapshot in motion.data:
        first, second = (_in_palm(hand, snapshot, palm, box) for box in boxes)
        gaps.append((second - first) @ axes[:, 1] - 2.0 * size[1])
        middles.append((first + second) / 2 + axes[:, 0] * height)
    beyond = max(float((points @ axes[:, 0]).max()) for points, _ in clouds) - depth
    return Pads(axes, np.array(gaps), np.array(middles), (boxes[0], boxes[1]), bool(half > _OVERLAP), beyond)


def _axes(closing: np.ndarray, pointing: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Returns the tool's axes as columns, in the palm's frame."""
    if np.linalg.norm(closing) < 1e-6:
        raise ValueError("the fingers do not move: the jaw does not close")
    y = closing / np.linalg.norm(closing)
    x = pointing - y * (pointing @ y)
    x /= np.linalg.norm(x)
    last = last * np.sign(last @ x)
    if last @ x > 0.8:  # what turns the hand is its axis, where fingers are not symmetric
        x = last
    x = _upright(x)
    y = _upright(y - x * (x @ y))
    y -= x * (x @ y)
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


def _upright(axis: np.ndarray) -> np.ndarray:
    """Returns a unit vector, exactly along an axis of the frame that it is along within 3°."""
    axis = axis / np.linalg.norm(axis)
    return np.round(axis) if np.abs(axis).max() > 0.9986 else axis


def _last_axis(model: mujoco.MjModel, parts: Parts) -> np.ndarray:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data.xmat[parts.palm].reshape(3, 3).T @ data.xaxis[parts.joints[-1]]


class _Face(NamedTuple):
    body: int
    inner: float
    end: float
    length: float
    sides: tuple[float, float]


def _face(points: np.ndarray, bodies: np.ndarray, axes: np.ndarray, sign: float, scale: float) -> _Face:
    """Returns the inner face of a finger's end, in the tool's axes."""
    along, across, lateral = (points @ axes).T
    end = along.max()
    tip = np.flatnonzero(along > end - min(_TIP, _TIP / scale * 1.6))
    inner = (sign * across[tip]).max()
    near = tip[sign * across[tip] > inner - _FACE]
    body = int(np.bincount(bodies[near]).argmax())
    near = near[bodies[near] == body]
    sides = float(lateral[near].min()), float(lateral[near].max())
    length = end - along[(bodies == body) & (sign * across > inner - 4 * _FACE)].min()
    return _Face(
        body,
        float(sign * inner),
        float(along[near].max()),
        float(length),
        sides,
    )


def _part(
    hand: mujoco.MjModel, data: mujoco.MjData, palm: int, body: int, pos: np.ndarray, axes: np.ndarray, size: np.ndarray
) -> Part:
    """Returns a box that is given in the palm's frame, in that of the body that carries it."""
    of_palm, of_body = data.xmat[palm].reshape(3, 3), data.xmat[body].reshape(3, 3)
    world = data.xpos[palm] + of_palm @ pos
    return Part(
        hand.body(body).name, of_body.T @ (world - data.xpos[body]), quaternion_of(of_body.T @ of_palm @ axes), size
    )


def _in_palm(hand: mujoco.MjModel, data: mujoco.MjData, palm: int, part: Part) -> np.ndarray:
    body = hand.body(part.body).id
    world = data.xpos[body] + data.xmat[body].reshape(3, 3) @ np.asarray(part.pos)
    return data.xmat[palm].reshape(3, 3).T @ (world - data.xpos[palm])


def quaternion_of(axes: np.ndarray) -> np.ndarray:
    """Returns the quaternion, `[4]`, of axes that are columns, `[3, 3]`."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(axes).ravel())
    return quaternion


def turned(pads: Pads) -> tuple[Pads, Pads]:
    """Returns the pads as they are, and with the hand turned by half a turn about the direction in which it points."""
    turn = np.diag([1.0, -1.0, -1.0])

    def other(part: Part) -> Part:
        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, np.asarray(part.quat, float))
        return dataclasses.replace(part, quat=quaternion_of(axes.reshape(3, 3) @ turn))

    first, second = pads.parts
    return pads, pads._replace(axes=pads.axes @ turn, parts=(other(second), other(first)))


def tool_of(pads: Pads, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the point between the pads around the cube and its axes, in the palm's frame."""
    order = np.argsort(pads.gaps)
    width = (CUBE_WIDTH + 2 * ROOM) / scale
    middle = [np.interp(width, pads.gaps[order], pads.middles[order, axis]) for axis in range(3)]
    return np.array(middle) - pads.axes[:, 0] * _ABOVE_ENDS / scale, pads.axes

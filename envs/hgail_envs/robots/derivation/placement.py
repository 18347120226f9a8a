"""Where an arm stands at the table: how far from the middle of the tasks' workspace, and in which posture."""

from typing import NamedTuple

import mujoco
import numpy as np

from hgail_envs.robots.base import START_HEIGHT
from hgail_envs.robots.inverse_kinematics import TURN_WEIGHT, damped_step

DOWNWARD = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Axes of a tool whose x points down and whose y is the world's, as columns."""

_FREE_TILT = 0.02  # metres to a radian of tilt, of an arm with too few joints to point downward everywhere
_ORIENTING = 6  # joints from which a tool can have any orientation
_SIDE = 0.15  # metres of the scene around the start, in which objects and goals are
_LOW, _HIGH = 0.0205, 0.45  # metres of the scene above the table, of the tool at the lowest and the highest goals
_SHARES = np.linspace(0.25, 0.8, 8)  # of its reach, of the distances that are tried
_TILTED = 0.1  # radians at the start, of an arm whose tilt is free
_RESTARTS = 12
_LONGEST, _SEARCH_STEPS = 0.1, 100  # metres of a step in the search for a posture
_NEAR, _STRAIGHT = 0.003, 0.05  # metres and radians within which a place is reached
_STRETCH, _USUAL = 0.6, 0.55  # how much a farther place is better, up to which share of the reach
_CLEAR = 0.03  # metres of the scene between the table and the origins of links
_SAMPLES = 1500


class Place(NamedTuple):
    """Where an arm stands, and how it comes to the workspace."""

    distance: float
    """Metres of the robot from its base to the gripper's start."""
    home: list[float]
    """Posture at the start, radians."""
    tilt_weight: float
    """See `hgail_envs.robots.description.Description`."""
    score: float
    """Larger for a posture farther from limits and singularities, with its elbow up."""


class _Arm:
    """The arm of a model with a tool on one of its bodies, in the scene's metres."""

    def __init__(
        self, model: mujoco.MjModel, joints: list[int], body: int, tool: np.ndarray, axes: np.ndarray, scale: float
    ) -> None:
        self._model, self._data, self._body = model, mujoco.MjData(model), body
        self._tool, self._axes, self._scale = tool, axes, scale
        self._qpos, self._dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._links = [int(model.jnt_bodyid[joint]) for joint in joints[2:]]
        self.limits = model.jnt_range[joints].T
        self.tilt_weight = TURN_WEIGHT if len(joints) >= _ORIENTING else _FREE_TILT

    def look(self, posture: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the tool's position, `[3]`, its axes, `[3, 3]`, and its Jacobian, `[6, joints]`."""
        model, data, jacobian = self._model, self._data, np.zeros((6, self._model.nv))
        data.qpos[self._qpos] = posture
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        frame = data.xmat[self._body].reshape(3, 3)
        position = data.xpos[self._body] + frame @ self._tool
        mujoco.mj_jac(model, data, jacobian[:3], jacobian[3:], position, self._body)
        jacobian[:3] *= self._scale
        return self._scale * position, frame @ self._axes, jacobian[:, self._dofs]

    def go(self, target: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, float, float]:
        """Returns the posture near another in which the tool comes to a target, and the errors, metres and radians."""
        posture = near.copy()
        for _ in range(_SEARCH_STEPS):
            position, axes, jacobian = self.look(posture)
            way, turn = target - position, 0.5 * np.cross(axes, DOWNWARD, axis=0).sum(axis=1)
            # Upside down the sum vanishes, too.
            turned = float(np.arccos(np.clip((np.trace(axes.T @ DOWNWARD) - 1.0) / 2.0, -1.0, 1.0)))
            far = float(np.linalg.norm(way))
            if far < _NEAR / 4 and turned < _STRAIGHT / 4:
                break
            way *= _LONGEST / max(_LONGEST, far)
            posture = posture + damped_step(
                way, turn, jacobian, near - posture, self.limits - posture, np, tilt_weight=self.tilt_weight
            )
        return posture, far, turned

    def margin(self, posture: np.ndarray) -> float:
        """Returns the least distance of a joint from its limits, in its range, at most 0.15."""
        least, most = self.limits
        return float(min(0.15, (np.minimum(posture - least, most - posture) / (most - least)).min()))

    def rate(self, posture: np.ndarray) -> tuple[float, bool]:
        """Returns how good a posture is, and whether its links are above the table."""
        singular = np.linalg.svd(self.look(posture)[2] * np.repeat([[1.0], [TURN_WEIGHT]], 3, axis=0), compute_uv=False)
        _, aside, heights = self._scale * self._data.xpos[self._links].T
        rating = self.margin(posture) + min(0.06, float(singular[-1])) + 0.3 * min(0.6, float(heights.mean()))
        rating -= float(np.abs(aside).mean())  # the elbow is up, not to the side
        rating -= float(np.abs(posture).max()) / 20.0  # several turns are no better than none
        return rating, bool(heights.min() > _CLEAR)


def find_place(
    model: mujoco.MjModel, joints: list[int], body: int, tool: np.ndarray, axes: np.ndarray, scale: float
) -> Place | None:
    """Returns the best place at which the tool of an arm reaches the tasks' workspace; None if there is none."""
    arm, rng = _Arm(model, joints, body, tool, axes, scale), np.random.default_rng(0)
    reach, found = reach_of(model, joints, body, tool), []
    for distance in _SHARES * reach:
        if distance * scale < _SIDE + 0.05:
            continue
        homes = _homes(arm, np.array([distance * scale, 0.0, START_HEIGHT]), rng)
        for rating, home in homes[:2]:
            if (corners := _reaches(arm, distance * scale, home)) is not None:
                stretched = _STRETCH * min(distance / reach, _USUAL)
                found.append(Place(float(distance), home.tolist(), arm.tilt_weight, rating + corners + stretched))
                break
    return max(found, key=lambda place: place.score, default=None)


def _homes(arm: _Arm, start: np.ndarray, rng: np.random.Generator) -> list[tuple[float, np.ndarray]]:
    """Returns postures at the start and their ratings, the best first."""
    found = []
    for restart in range(_RESTARTS):
        widest = np.pi / (1 + restart % 2)  # every other one near zero, the makers' usual posture
        least, most = np.clip(arm.limits, -widest, widest)
        posture, far, turned = arm.go(start, rng.uniform(least, most))
        rating, clear = arm.rate(posture)
        if far < _NEAR and (turned < _STRAIGHT or (arm.tilt_weight < TURN_WEIGHT and turned < _TILTED)) and clear:
            found.append((rating, posture))
    return sorted(found, key=lambda home: -home[0])


def _reaches(arm: _Arm, distance: float, home: np.ndarray) -> float | None:
    """Returns the least margin at the corners of the workspace, or None where one is out of reach."""
    margins = []
    for height in (_LOW, _HIGH):
        free = arm.tilt_weight < TURN_WEIGHT and height == _HIGH
        for x in (-_SIDE, _SIDE):
            for y in (-_SIDE, _SIDE):
                posture, far, turned = arm.go(np.array([distance + x, y, height]), home)
                if far > (4.0 if free else 1.0) * _NEAR or (turned > _STRAIGHT and not free):
                    return None
                margins.append(arm.margin(posture))
    return min(margins)


def reach_of(model: mujoco.MjModel, joints: list[int], body: int, tool: np.ndarray) -> float:
    """Returns the farthest distance, metres, of a point of a body from the second joint, of random postures."""
    data, rng, far = mujoco.MjData(model), np.random.default_rng(0), 0.0
    for _ in range(_SAMPLES):
        data.qpos[model.jnt_qposadr[joints]] = rng.uniform(*np.clip(model.jnt_range[joints].T, -np.pi, np.pi))
        mujoco.mj_kinematics(model, data)
        point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ tool
        far = max(far, float(np.linalg.norm(point - data.xanchor[joints[1]])))
    return far

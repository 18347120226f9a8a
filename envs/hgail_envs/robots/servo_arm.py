"""Arms whose joints have position servos, led by damped least squares."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax import math

from hgail_envs.engines import Control, Engine
from hgail_envs.robots.arm_model import PREFIX, attach_arm, touch_by_priority
from hgail_envs.robots.base import BASE_X, CONTROL_PERIOD, START_HEIGHT, ArmPhysics, Robot
from hgail_envs.robots.description import read_description
from hgail_envs.robots.full_model import FullModel, touch_with_bodies
from hgail_envs.robots.grip import tabulate_hand, without_weight_beyond_grip
from hgail_envs.robots.hand import PADS, finger_fields, pad_fields, rotation
from hgail_envs.robots.hand_boxes import add_hand_boxes
from hgail_envs.robots.inverse_kinematics import damped_step
from hgail_envs.robots.kinematics import Chain, Pose
from hgail_envs.scenes import TABLE_HEIGHT, VISUAL_GROUP, read_scene, without_visuals
from hgail_envs.variation import ModelFactors

_START = (1.344, 0.749, TABLE_HEIGHT)  # below the gripper's start, as the Fetch's, metres
_RAISE = 2.0  # leads per metre below the lowest height, for a tilted hand whose pads rub the table
_DOWNWARD = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # of the tool, x down and y along y
_SHARE = 0.5  # of its lead, at least, that a joint covers in an action
# Iterations of the solver, at least, by the friction cone: fingers that are coupled need more than the Fetch's, and an
# elliptic cone more again. With 10 the UR5e throws cubes off the table; with 20 one push in a hundred is 0.5 mm aside.
_ITERATIONS = {mujoco.mjtCone.mjCONE_PYRAMIDAL: 10, mujoco.mjtCone.mjCONE_ELLIPTIC: 30}
_AT_START = 0.01  # metres of the robot, within which the search ends where the start is in reach
_STRETCH = 0.97  # of the reach: an arm that is stretched shakes, and tilts its hand
_BISECTIONS, _BEYOND = 6, 0.6  # of the search for it, which begins so far beyond the start, metres
_LONGEST = 0.05  # metres of a step in the search for a posture
_SEARCH_STEPS, _SETTLE_STEPS = 300, 400
_HAND = "hand"  # text in the model of a scene whose hand opens
_OF_HAND = f'<mujoco><custom><text name="{_HAND}" data="opens"/></custom></mujoco>'.encode()


class ServoArm(Robot):
    """An arm with servos, above the table of the Fetch's scenes; `name` is that of a file in `assets/robots`.

    Its base stands on the table's level, so far from it that the gripper starts where the Fetch's does. An action leads
    the joints from where they are, at most twice as far as their speed allows. The arm is weightless, as a real one is
    to its user once its payload is set.
    """

    def __init__(self, name: str, scene: str, base_x: float = BASE_X, start_height: float = START_HEIGHT) -> None:
        self.name, self._arm = name, read_description(name)
        self.scale = self._arm.scale
        self._start = np.add(_START, [base_x - BASE_X, 0.0, start_height])
        super().__init__(scene, base_x, start_height)
        model, hand, tool, scale = self.model, self._arm.hand, self._arm.tool, self._arm.scale
        joints = [model.joint(PREFIX + joint).id for joint in self._arm.joints]
        self._joints, self._dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._limits = np.asarray(model.jnt_range[joints].T, np.float32)
        self._most = np.asarray(self._arm.top_speed, np.float32) * np.float32(CONTROL_PERIOD / _SHARE)
        table = tabulate_hand(name)
        self._gaps, self._openings, self._closed, self._opened = table.gaps, table.openings, table.closed, table.opened
        self._hand_servos = len(joints) + np.arange(len(hand.joints))
        of_robot = [joint for joint in range(model.njnt) if model.joint(joint).name.startswith(PREFIX)]
        of_hand = [joint for joint in of_robot if joint not in joints]
        self._hand_joints, self._hand_dofs = model.jnt_qposadr[of_hand], model.jnt_dofadr[of_hand]
        self._pads = [Chain(model, pad, PREFIX + tool.body) for pad in PADS]
        self._closing = np.asarray(rotation(tool.quat)[:, 1], np.float32)
        self._thickness = scale * (self._arm.right_pad.size[1] + self._arm.left_pad.size[1])
        pads = [getattr(self._arm, pad) for pad in PADS]
        self._faces = [(scale * np.asarray(pad.size) * rotation(pad.quat)).astype(np.float32) for pad in pads]
        self._downward = np.asarray(_quaternion(_DOWNWARD @ rotation(tool.quat).T), np.float32)
        self._step = functools.partial(damped_step, tilt_weight=self._arm.tilt_weight)
        self._home = np.asarray(self._posture(np.array(self._arm.home)), np.float32)
        self.lowest_height = TABLE_HEIGHT + table.depth + scale * self._arm.clearance
        self._start[2] = max(self._start[2], self.lowest_height)
        self._check_start()
        self._base = self._start[:2] - scale * np.asarray(self._arm.reach)
        self._farthest = _STRETCH * self._reach()

    def spec(self) -> mujoco.MjSpec:
        return self._scene(full=False)

    def _scene(self, full: bool) -> mujoco.MjSpec:
        spec = read_scene(self.scene, {"robot.xml": b"<mujoco><worldbody/></mujoco>", "hand.xml": _OF_HAND})
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # servos of small inertia need it at 5 ms
        x, y = self._start[:2] - self._arm.scale * np.asarray(self._arm.reach)
        attach_arm(self.name, spec, [x, y, TABLE_HEIGHT], stays_closed=spec.text(_HAND) is None, full=full)
        iterations = _ITERATIONS[mujoco.mjtCone(spec.option.cone)]  # of the arm's model now
        spec.option.iterations = max(spec.option.iterations, iterations)
        spec.option.ls_iterations = max(spec.option.ls_iterations, iterations)
        if full:
            bodies = {part: PREFIX + getattr(self._arm, part).body for part in ("palm", *PADS)}
            touch_with_bodies(spec, bodies, PREFIX)
        else:
            add_hand_boxes(spec, self.name)  # first: they touch as the scene's pads
            touch_by_priority(spec)
        pedestal = spec.worldbody.add_geom(pos=[x, y, TABLE_HEIGHT / 2], size=[0.1, TABLE_HEIGHT / 2, 0.0])
        pedestal.type, pedestal.contype, pedestal.conaffinity = mujoco.mjtGeom.mjGEOM_CYLINDER, 0, 0
        pedestal.group, pedestal.rgba = VISUAL_GROUP, [0.36, 0.36, 0.38, 1.0]
        return spec

    def load(self, visual: bool = False) -> mujoco.MjModel:
        """Compiles the scene, whose objects weigh no more than the hand can hold; see `Robot`."""
        return without_weight_beyond_grip(super().load(visual), self.name)

    def full_model(self, visual: bool = False) -> mujoco.MjModel:
        """Compiles the scene with the arm as its maker has it, see `hgail_envs.robots.full_model`; the same joints."""
        spec = self._scene(full=True)
        model = (spec if visual else without_visuals(spec)).compile()
        return without_weight_beyond_grip(model, self.name)

    def reference_engine(self, slowdown: int = 1) -> Engine:
        model, hand = self.full_model(), self._arm.hand
        joints, drives = (
            [model.joint(PREFIX + name).id for name in names] for names in (self._arm.joints, hand.joints)
        )
        start = model.qpos0.copy()
        start[self._joints] = self._home
        ends = np.array(drives), self._closed, self._opened
        return FullModel(model, start, np.array(joints), ends, self._arm.servo_frequency, slowdown)

    def settle(self, offset: np.ndarray | float = 0.0) -> mujoco.MjData:
        data = mujoco.MjData(self.model)
        data.qpos[self._joints] = posture = self._posture(self._home, offset)
        data.ctrl[:] = [*posture, *self._closed]
        mujoco.mj_step(self.model, data, nstep=_SETTLE_STEPS)
        mujoco.mj_forward(self.model, data)
        return data

    def gripper(self, qpos: jax.Array, qvel: jax.Array) -> Pose:
        """Returns the gripper's pose and velocity, by the Jacobian that `control` needs, too; see `Robot`."""
        quaternion, jacobian = self._chain.jacobian(qpos)
        site, body, _ = self._chain.follow(qpos)
        return Pose(site, (jacobian[:3] * qvel[self._dofs]).sum(axis=1), body, quaternion)

    def _posture(self, near: np.ndarray, offset: np.ndarray | float = 0.0) -> np.ndarray:
        """Returns joint positions with the gripper `offset` from its start, pointing downward, `[joints]`."""
        model, data, jacobian = self.model, mujoco.MjData(self.model), np.zeros((6, self.model.nv))
        site, posture = model.site("grip").id, near.copy()
        for _ in range(_SEARCH_STEPS):
            data.qpos[self._joints] = posture
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
            way = self._start + offset - data.site_xpos[site]
            turn = 0.5 * np.cross(data.site_xmat[site].reshape(3, 3), _DOWNWARD, axis=0).sum(axis=1)
            way *= _LONGEST / max(_LONGEST, float(np.linalg.norm(way)))
            step = self._step(way, turn, jacobian[:, self._dofs], near - posture, self._limits - posture, np)
            before, posture = posture, (posture + step).astype(posture.dtype)
            if np.array_equal(posture, before):
                break  # no further step would move a joint
        return posture

    def _check_start(self) -> None:
        """Raises a ValueError if the gripper does not come to its start."""
        away = self._short_of(np.zeros(3))
        if away > _AT_START:
            raise ValueError(
                f"robot {self.name!r}: the gripper stays {1000 * away:.0f} mm away from its start above the table; look"
                " at home, reach and [tool] of its description"
            )

    def _short_of(self, offset: np.ndarray) -> float:
        """Returns how far the gripper stays away from a place `offset`, `[3]`, from its start, metres of the robot."""
        data = mujoco.MjData(self.model)
        data.qpos[self._joints] = self._posture(self._home, offset)
        mujoco.mj_kinematics(self.model, data)
        return float(np.linalg.norm(data.site("grip").xpos - self._start - offset)) / self.scale

    def _reach(self) -> float:
        """Returns how far from the base's axis the gripper comes at the height of its start, metres, by bisection."""
        start = self._start[:2] - self._base
        distance = float(np.linalg.norm(start))
        outward = np.append(start / distance, 0.0)
        near, far = 0.0, _BEYOND
        for _ in range(_BISECTIONS):
            middle = 0.5 * (near + far)
            near, far = (middle, far) if self._short_of(middle * outward) < _AT_START else (near, middle)
        return distance + near

    def control(self, physics: ArmPhysics, displacement: jax.Array, grip: jax.Array | None) -> Control:
        """Returns what the servos are led to: joints for the displacement, and fingers by `grip` metres each."""
        joints = physics.qpos[self._joints]
        quaternion, jacobian = self._chain.jacobian(physics.qpos)
        turn = math.quat_mul(self._downward, math.quat_inv(quaternion))
        rotation = 2.0 * jnp.sign(turn[0]) * turn[1:]
        way = self._arm.lead * displacement
        lowest = _RAISE * (self.lowest_height - physics.gripper_position[2])  # servos would press on the table
        aside = physics.gripper_position[:2] + way[:2] - self._base
        beyond = aside * jnp.minimum(self._farthest / jnp.linalg.norm(aside) - 1.0, 0.0)
        way = jnp.append(way[:2] + beyond, jnp.maximum(way[2], lowest))
        step = self._step(way, rotation, jacobian, self._home - joints, self._limits - joints)
        step /= jnp.maximum(1.0, jnp.max(jnp.abs(step) / self._most))
        return Control(
            mocap_pos=jnp.zeros((0, 3)),
            mocap_quat=jnp.zeros((0, 4)),
            ctrl=jnp.concatenate([joints + step, self._hand_control(physics, grip)]),
        )

    def _hand_control(self, physics: ArmPhysics, grip: jax.Array | None) -> jax.Array:
        if grip is None:
            return jnp.asarray(self._closed)
        gap = jnp.clip(self.gap(physics.qpos) + 2.0 * grip, 0.0, self.widest_gap(physics.factors))
        return self._closed + gap / self._gaps[-1] * (self._opened - self._closed)

    def keep_closed(self, qpos: jax.Array) -> jax.Array:
        return qpos  # its servos do

    def opened(self, qpos: jax.Array, gap: jax.Array) -> jax.Array:
        joints = [jnp.interp(gap, self._gaps, column) for column in self._openings.T]
        return qpos.at[self._hand_joints].set(jnp.stack(joints))

    def gap(self, qpos: jax.Array) -> jax.Array:
        """Returns the distance between the middles of the pads' faces by the kinematics of both; see `Robot`."""
        right, left = (pad.site(qpos) for pad in self._pads)
        return ((right - left) * self._closing).sum() - self._thickness

    def narrowest_gap(self, qpos: jax.Array) -> jax.Array:
        (right, _, right_turn), (left, _, left_turn) = (pad.follow(qpos) for pad in self._pads)
        turned = zip(self._faces, (right_turn, left_turn), strict=True)
        thickness = sum(_extent(faces, self._closing, turn) for faces, turn in turned)
        return ((right - left) * self._closing).sum() - thickness

    def widest_gap(self, factors: ModelFactors | None = None) -> jax.Array | float:
        return self._gaps[-1] if factors is None else self._gaps[-1] * factors.hand_width

    def hand_fields(self, factors: ModelFactors, others: dict[str, jax.Array]) -> dict[str, jax.Array]:
        fingers = factors.finger_force, factors.finger_speed
        return pad_fields(self.model, factors.pad_size, others) | finger_fields(
            self.model, self._hand_servos, *fingers, others
        )

    def fingers(self, physics: ArmPhysics) -> tuple[jax.Array, jax.Array]:
        rates = jnp.zeros_like(physics.qpos).at[self._hand_joints].set(physics.qvel[self._hand_dofs])
        gap, rate = jax.jvp(self.gap, (physics.qpos,), (rates,))
        return jnp.full(2, gap / 2), jnp.full(2, rate / 2)


def _extent(half_edges: np.ndarray, direction: np.ndarray, quaternion: jax.Array) -> jax.Array:
    """Returns how far a box extends from its middle along a direction, `[]`.

    The columns of `half_edges`, `[3, 3]`, are in the frame of a body that is turned by the `quaternion`, `[4]`.
    """
    real, imaginary = quaternion[0], quaternion[1:]
    twice = 2.0 * jnp.cross(imaginary, direction)
    in_body = direction - real * twice + jnp.cross(imaginary, twice)
    return jnp.abs((in_body[:, None] * half_edges).sum(axis=0)).sum()


def _quaternion(axes: np.ndarray) -> np.ndarray:
    """Returns the quaternion, `[4]`, of a rotation matrix."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    return quaternion

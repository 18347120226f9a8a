"""An arm as its maker has it, on C MuJoCo: the reference of policies that were trained in a scene of simpler shapes.

All of the maker's colliding geoms touch, links and meshes too, by the contact parameters of their files, and the
joints keep the maker's position servos, damping and friction.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from hgail_envs.engines import CEngine, Control, resolve_impl
from hgail_envs.engines.base import StateT
from hgail_envs.robots.base import CONTROL_PERIOD, REFERENCE_SUBSTEPS

_ITERATIONS = 100  # of the solver


def touch_with_bodies(scene: mujoco.MjSpec, bodies: Mapping[str, str], prefix: str) -> None:
    """Lets a robot touch with its own geoms what the geoms of other names touch by a scene's pairs.

    `bodies` are the robot's that carry those geoms, by their names. Sensors of contacts are then of these bodies.
    """
    own = [geom for body in scene.bodies if body.name.startswith(prefix) for geom in body.geoms]
    own = [geom for geom in own if geom.contype or geom.conaffinity]
    used = int(np.bitwise_or.reduce([geom.contype | geom.conaffinity for geom in own], initial=1))
    of_scene = 1 << used.bit_length()  # a bit of its own: things of the scene touch each other by pairs alone
    for geom in own:
        geom.conaffinity |= of_scene
    for pair in list(scene.pairs):
        others = {pair.geomname1, pair.geomname2} - set(bodies)
        if len(others) < 2:
            for name in others:
                scene.geom(name).contype, scene.geom(name).conaffinity = of_scene, 0
            scene.delete(pair)
    for sensor in scene.sensors:
        if sensor.objname in bodies:
            sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_BODY, bodies[sensor.objname]
        if sensor.refname in bodies:
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, bodies[sensor.refname]
    scene.option.iterations, scene.option.ls_iterations = _ITERATIONS, _ITERATIONS
    scene.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)


class FullModel(CEngine):
    """C MuJoCo with the full model, for the control of the training's scene: positions of joints and of the hand.

    The maker's servos are led so that joints move as the training's servos, critically damped, would move them: their
    lag, damping over stiffness, is fed forward, and so is the joint's inertia.

    Args:
      model: the scene with the full arm, whose joints are those of the training's.
      start: positions of its joints at the start, `[nq]`.
      joints: numbers of the arm's joints, from the base on.
      hand: numbers of the driven joints of the hand, and their positions when it is closed and open, `[drives]` each.
      frequency: of the training's servos, Hz.
      slowdown: duration of an action, times `CONTROL_PERIOD`.
    """

    name = "reference"

    def __init__(
        self,
        model: mujoco.MjModel,
        start: np.ndarray,
        joints: np.ndarray,
        hand: tuple[np.ndarray, np.ndarray, np.ndarray],
        frequency: float,
        slowdown: int = 1,
    ) -> None:
        resolve_impl("c")  # refuses a GPU
        self._made = model, start, joints, hand, frequency, slowdown
        super().__init__(model, slowdown * CONTROL_PERIOD, slowdown * REFERENCE_SUBSTEPS, 0)
        data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
        data.qpos[:] = start
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        of_joint = np.where(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, model.actuator_trnid[:, 0], -1)
        servos = [int(np.flatnonzero(of_joint == joint)[0]) for joint in joints]
        dofs, self._servos = model.jnt_dofadr[joints], np.array(servos)
        stiffness, damping = (
            -model.actuator_biasprm[servos, 1],
            model.dof_damping[dofs] - model.actuator_biasprm[servos, 2],
        )
        self._lag = np.asarray(damping / stiffness, np.float32)
        self._inertia = np.asarray(inertia.diagonal()[dofs] / stiffness, np.float32)
        self._qpos, self._qvel = model.jnt_qposadr[joints], dofs
        self._rate = 2.0 * np.pi * frequency / slowdown
        # Where its length is that of the hand closed, or open, a servo has no force.
        self.hand_servos, (drives, *ends) = np.setdiff1d(np.arange(model.nu), servos), hand
        self._ends, controls = [np.asarray(end, np.float32) for end in ends], []
        for end in ends:
            data.qpos[model.jnt_qposadr[drives]] = end
            mujoco.mj_forward(model, data)
            bias = model.actuator_biasprm[:, 0] + model.actuator_biasprm[:, 1] * data.actuator_length
            controls.append(np.asarray(-bias / model.actuator_gainprm[:, 0], np.float32)[self.hand_servos])
        self._closed, self._opened = controls

    def __reduce__(self):
        return type(self), self._made

    def with_substeps(self, substeps: int) -> "FullModel":
        """Returns itself, whose physics steps are those of the reference."""
        del substeps
        return self

    def step(self, state: StateT, control: Control) -> StateT:
        """Steps on the host; see `Engine`."""
        ctrl = self.commands(state.qpos, state.qvel, control.ctrl)
        return super().step(state, control.replace(ctrl=ctrl.reshape(-1)))

    def commands(self, qpos: jax.Array, qvel: jax.Array, control: jax.Array) -> jax.Array:
        """Returns controls of the maker's servos for each physics step of an action, `[substeps, nu]`.

        `qpos`, `[nq]`, and `qvel`, `[nv]`, are at its start; `control` is that of the training's scene.
        """
        count, (closed, opened) = len(self._servos), self._ends
        share = ((control[count:] - closed) / (opened - closed)).mean()
        arm = self._lead(qpos[self._qpos], qvel[self._qvel], control[:count])
        both = jnp.zeros((self.substeps, self.model.nu)).at[:, self._servos].set(arm)
        return both.at[:, self.hand_servos].set(self.hand_controls(share))

    def hand_controls(self, share: Any) -> Any:
        """Returns controls of the servos `hand_servos` for a share of the widest gap, clipped to [0, 1]."""
        return self._closed + share.clip(0.0, 1.0) * (self._opened - self._closed)

    def _lead(self, start: jax.Array, speed: jax.Array, end: jax.Array) -> jax.Array:
        """Returns controls of the joints' servos for each physics step, `[substeps, joints]`."""
        time = (self.period / self.substeps * np.arange(1, self.substeps + 1, dtype=np.float32))[:, None]
        rate, behind, decay = self._rate, start - end, np.exp(-self._rate * time)
        slope = speed + rate * behind
        place = end + (behind + slope * time) * decay
        velocity = (speed - rate * slope * time) * decay
        acceleration = -(rate**2) * (place - end) - 2.0 * rate * velocity
        return place + self._lag * velocity + self._inertia * acceleration

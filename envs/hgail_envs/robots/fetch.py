"""The Fetch, its gripper pulled by a mocap body through a weld constraint.

The reference is Gymnasium-Robotics' `fetch_env.py` and `robot_env.py` (v4, C MuJoCo).
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from hgail_envs.engines import Control
from hgail_envs.robots.base import REFERENCE_SUBSTEPS, ArmPhysics, Robot
from hgail_envs.scenes import assets_directory, read_scene
from hgail_envs.variation import ModelFactors

LEAD = 0.05
"""Metres by which the mocap body leads the gripper for a unit action."""
PARTS = {"robot.xml": "fetch.xml", "hand.xml": "fetch_hand.xml"}
"""Files in `assets/robots`, by the names under which scenes include them."""

_BASE_Y = 0.48  # metres
_DOWNWARD = np.array([1.0, 0.0, 1.0, 0.0])  # quaternion, not normalised, that points the gripper at the table
_FINGERS = ("right_finger", "left_finger")  # names of joints and actuators, as an observation has their positions
_GRIPPER_OFFSET = np.array([-0.498, 0.005, -0.431])  # metres from the gripper's outstretched position to the table
_SETTLE_PERIODS = 10  # actions, as in the reference
_PADS = ("right_pad", "left_pad")
_HEIGHT, _WIDTH = 0, 2  # axes of a pad, along the first of which the gripper points downward; it closes along the other


class Fetch(Robot):
    """The Fetch; see `Robot`. Where a scene includes no `hand.xml` its fingers are blocked."""

    def __init__(self, *args: str | float, **kwargs: float) -> None:
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]
        model = self.model
        self._fingers = np.array([model.joint(name).id for name in _FINGERS])
        self._finger_qpos, self._finger_dofs = model.jnt_qposadr[self._fingers], model.jnt_dofadr[self._fingers]
        self._pads = np.array([model.geom(name).id for name in _PADS])
        self._widest = model.jnt_range[self._fingers, 1].sum()

    def spec(self) -> mujoco.MjSpec:
        folder = assets_directory() / "robots"
        return read_scene(self.scene, {part: (folder / file).read_bytes() for part, file in PARTS.items()})

    def settle(self, offset: np.ndarray | float = 0.0) -> mujoco.MjData:
        """Pulls the gripper to its start with C MuJoCo, as the reference does; see `Robot`."""
        data = mujoco.MjData(self.model)
        data.joint("base_x").qpos, data.joint("base_y").qpos = self.base_x, _BASE_Y
        mujoco.mj_forward(self.model, data)
        data.mocap_pos[0] = data.site("grip").xpos + _GRIPPER_OFFSET + [0.0, 0.0, self.start_height]
        data.mocap_pos[0] += offset
        data.mocap_quat[0] = _DOWNWARD
        mujoco.mj_step(self.model, data, nstep=_SETTLE_PERIODS * REFERENCE_SUBSTEPS)
        mujoco.mj_forward(self.model, data)
        return data

    def control(self, physics: ArmPhysics, displacement: jax.Array, grip: jax.Array | None) -> Control:
        """Returns the mocap body's pose, which pulls the gripper, and the servos' that lead the fingers by `grip`."""
        return Control(
            mocap_pos=(physics.body_position + LEAD * displacement)[None],
            mocap_quat=(physics.body_quaternion + _DOWNWARD)[None],  # the reference adds them too; MuJoCo normalises
            ctrl=jnp.zeros(self.model.nu) if grip is None else physics.qpos[self._finger_qpos] + grip,
        )

    def keep_closed(self, qpos: jax.Array) -> jax.Array:
        return qpos.at[self._finger_qpos].set(0.0)

    def opened(self, qpos: jax.Array, gap: jax.Array) -> jax.Array:
        return qpos.at[self._finger_qpos].set(gap / 2) if self.model.nu else qpos

    def gap(self, qpos: jax.Array) -> jax.Array:
        return qpos[self._finger_qpos].sum()

    def widest_gap(self, factors: ModelFactors | None = None) -> jax.Array | float:
        return self._widest if factors is None else self._widest * factors.hand_width

    def fingers(self, physics: ArmPhysics) -> tuple[jax.Array, jax.Array]:
        return physics.qpos[self._finger_qpos], physics.qvel[self._finger_dofs]

    def hand_fields(self, factors: ModelFactors, others: dict[str, jax.Array]) -> dict[str, jax.Array]:
        fields = self._pad_fields(factors.pad_size, others)
        if self.model.nu:
            fields |= self._finger_fields(factors.finger_force, factors.finger_speed, others)
            fields["jnt_range"] = self.field("jnt_range").at[self._fingers, 1].multiply(factors.hand_width)
        return fields

    def _pad_fields(self, size: jax.Array | float, others: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """Returns the fields that differ for pads `size` times as wide and high, whose lower ends stay in place."""
        pads, axes = self._pads, np.array([_HEIGHT, _WIDTH])
        of_pads = (pads[:, None], axes)
        shorter = self.model.geom_size[pads, _HEIGHT].astype(np.float32) * (1.0 - size)
        sizes = others.get("geom_size", self.field("geom_size")).at[of_pads].multiply(size)
        radii = others.get("geom_rbound", self.field("geom_rbound"))
        boxes = others.get("geom_aabb", self.field("geom_aabb"))  # centres, then half sizes
        return {
            "geom_size": sizes,
            "geom_rbound": radii.at[pads].set(jnp.linalg.norm(sizes[pads], axis=-1)),
            "geom_aabb": boxes.at[pads[:, None], 3 + axes].multiply(size),
            "geom_pos": self.field("geom_pos").at[pads, _HEIGHT].add(shorter),
        }

    def _finger_fields(
        self, force: jax.Array | float, speed: jax.Array | float, others: dict[str, jax.Array]
    ) -> dict[str, jax.Array]:
        """Returns the fields that differ for servos of other force and speed.

        A servo is a mass on a spring with a damper, m x″ + d x′ + k x = k u. With time scaled by `speed` it is
        m / speed², d / speed and k; scaling all three by `force` scales the force alone.
        """
        dofs, servos = self._finger_dofs, np.array([self.model.actuator(name).id for name in _FINGERS])
        heavier = force / speed**2
        mass = self.model.dof_M0[dofs]
        more = (mass * (heavier - 1.0)).astype(jnp.float32)  # all of it armature: the finger's weight stays
        return {
            "dof_armature": self.field("dof_armature").at[dofs].add(more),
            "dof_damping": self.field("dof_damping").at[dofs].multiply(force / speed),
            "dof_invweight0": others.get("dof_invweight0", self.field("dof_invweight0")).at[dofs].divide(heavier),
            "actuator_gainprm": self.field("actuator_gainprm").at[servos].multiply(force),
            "actuator_biasprm": self.field("actuator_biasprm").at[servos].multiply(force),
        }

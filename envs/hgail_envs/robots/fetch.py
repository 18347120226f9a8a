"""The Fetch, its gripper pulled by a mocap body through a weld constraint.

The reference is Gymnasium-Robotics' `fetch_env.py` and `robot_env.py` (v4, C MuJoCo).
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from hgail_envs.engines import Control
from hgail_envs.robots.base import REFERENCE_SUBSTEPS, ArmPhysics, Robot
from hgail_envs.robots.hand import field, finger_fields, pad_fields
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


class Fetch(Robot):
    """The Fetch; see `Robot`. Where a scene includes no `hand.xml` its fingers are blocked."""

    name = "fetch"
    lowest_height = 0.417  # where the weld gives way

    def __init__(self, *args: str | float, **kwargs: float) -> None:
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]
        model = self.model
        self._fingers = np.array([model.joint(name).id for name in _FINGERS])
        self._finger_qpos, self._finger_dofs = model.jnt_qposadr[self._fingers], model.jnt_dofadr[self._fingers]
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
        fields = pad_fields(self.model, factors.pad_size, others)
        if self.model.nu:
            servos = np.array([self.model.actuator(name).id for name in _FINGERS])
            fields |= finger_fields(self.model, servos, factors.finger_force, factors.finger_speed, others)
            fields["jnt_range"] = field(self.model, "jnt_range").at[self._fingers, 1].multiply(factors.hand_width)
        return fields

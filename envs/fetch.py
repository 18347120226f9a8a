"""What all Fetch tasks share: the arm on MJX and its end-effector control.

The reference is Gymnasium-Robotics' `fetch_env.py` and `robot_env.py` (v4, C MuJoCo).
"""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from envs.base import GoalEnv
from envs.scenes import load_scene

CONTROL_PERIOD = 0.04
"""Seconds between two actions."""
ACCURATE_SUBSTEPS = 20
"""Physics steps per action in the reference: 20 of 2 ms."""
FAST_SUBSTEPS = 4
"""The fewest physics steps per action, 4 of 10 ms: the gripper's weld, of time constant 20 ms, bears no longer ones."""

_DISPLACEMENT_SCALE = 0.05  # metres that the mocap body leads the gripper by for a unit action
_DOWNWARD = np.array([1.0, 0.0, 1.0, 0.0])  # quaternion (not normalised) that points the gripper at the table
_FINGERS = ("right_finger", "left_finger")
_BASE_POSITION = {"base_x": 0.405, "base_y": 0.48}  # metres
_GRIPPER_OFFSET = np.array([-0.498, 0.005, -0.231])  # metres from the gripper's outstretched position to its start
_SETTLE_PERIODS = 10


class FetchEnv(GoalEnv):
    """The Fetch arm, its gripper pulled by a mocap body through a weld constraint.

    An action is four numbers in [-1, 1]: three end-effector displacements (x, y, z; a unit moves the gripper about
    33 mm once it is up to speed) and the gripper command. The physics state is an `mjx.Data`.

    Args:
      scene: the scene's name, e.g. `"fetch/reach"`.
      impl: physics implementation: `"auto"` (the best available), `"jax"` or `"warp"`.
      substeps: physics steps per action, from `FAST_SUBSTEPS` to `ACCURATE_SUBSTEPS`; an action always lasts
        `CONTROL_PERIOD`.

    Raises:
      ValueError: an unknown or unavailable `impl`, or a number of substeps out of range.

    """

    episode_length = 50
    action_size = 4
    success_threshold = 0.05

    def __init__(self, scene: str, impl: str = "auto", substeps: int = ACCURATE_SUBSTEPS):
        if not FAST_SUBSTEPS <= substeps <= ACCURATE_SUBSTEPS:
            raise ValueError(f"substeps is {substeps}; it must be from {FAST_SUBSTEPS} to {ACCURATE_SUBSTEPS}")
        self.scene, self.impl = scene, resolve_impl(impl)
        self.substeps: int | jax.Array = substeps
        self.model = load_scene(scene)
        self._gripper_body = self.model.body("gripper").id
        self._gripper_site = self.model.site("grip").id
        self._finger_qpos = self.model.jnt_qposadr[[self.model.joint(name).id for name in _FINGERS]]
        settled = _settle(self.model)
        self.model.opt.timestep = CONTROL_PERIOD / substeps
        self._mjx_model = mjx.put_model(self.model, impl=self.impl)
        self._initial_physics = mjx.put_data(self.model, settled, impl=self.impl)
        self.initial_gripper_position = settled.site("grip").xpos.copy()

    def accurate(self, when: jax.Array | bool = True) -> "FetchEnv":
        """Returns the task with `ACCURATE_SUBSTEPS` where `when`, which may be traced, and with its own elsewhere."""
        env = copy.copy(self)
        env.substeps = jnp.where(when, ACCURATE_SUBSTEPS, self.substeps)
        env._mjx_model = self._mjx_model.tree_replace({"opt.timestep": CONTROL_PERIOD / env.substeps})
        return env

    def gripper_position(self, physics: mjx.Data) -> jax.Array:
        """Returns the position of the point between the fingers, `[3]`, metres, world frame."""
        return physics.site_xpos[self._gripper_site]

    def gripper_velocity(self, physics: mjx.Data) -> jax.Array:
        """Returns the gripper's linear velocity times `CONTROL_PERIOD`, `[3]`, metres, as the reference has it."""
        angular, linear = jnp.split(physics.cvel[self._gripper_body], 2)
        origin = physics.subtree_com[self.model.body_rootid[self._gripper_body]]
        return (linear + jnp.cross(angular, self.gripper_position(physics) - origin)) * CONTROL_PERIOD

    def reset_physics(self, rng: jax.Array) -> mjx.Data:
        del rng  # the arm always starts from the same pose
        return self._initial_physics

    def _move(self, physics: mjx.Data, displacement: jax.Array) -> mjx.Data:
        """Pulls the gripper by a displacement, `[3]` in [-1, 1], and runs the physics for `CONTROL_PERIOD`."""
        physics = physics.replace(
            mocap_pos=(physics.xpos[self._gripper_body] + _DISPLACEMENT_SCALE * displacement)[None],
            mocap_quat=(physics.xquat[self._gripper_body] + _DOWNWARD)[None],
        )
        return jax.lax.fori_loop(0, self.substeps, lambda _, data: mjx.step(self._mjx_model, data), physics)

    def _block_fingers(self, physics: mjx.Data) -> mjx.Data:
        """Puts the fingers back to their closed position."""
        return physics.replace(qpos=physics.qpos.at[self._finger_qpos].set(0.0))

    def _observe_kinematics(self, physics: mjx.Data) -> mjx.Data:
        """Brings positions and velocities in the world frame up to date with `qpos` and `qvel`."""
        physics = mjx.kinematics(self._mjx_model, physics)
        return mjx.com_vel(self._mjx_model, mjx.com_pos(self._mjx_model, physics))


def resolve_impl(impl: str) -> str:
    """Returns the MJX implementation that `"auto"`, `"jax"` or `"warp"` stands for here.

    Raises:
      ValueError: `impl` is none of these, or is not available.

    """
    if impl == "warp":
        raise ValueError("impl 'warp' is not yet supported; use 'jax' or 'auto'")
    if impl not in ("auto", "jax"):
        raise ValueError(f"unknown impl {impl!r}; choose from auto, jax, warp")
    return "jax"


def _settle(model: mujoco.MjModel) -> mujoco.MjData:
    """Brings the arm to its start, as the reference does: pull the gripper there with C MuJoCo and let it settle."""
    data = mujoco.MjData(model)
    for joint, position in _BASE_POSITION.items():
        data.joint(joint).qpos = position
    mujoco.mj_forward(model, data)
    data.mocap_pos[0] = data.site("grip").xpos + _GRIPPER_OFFSET
    data.mocap_quat[0] = _DOWNWARD
    mujoco.mj_step(model, data, nstep=_SETTLE_PERIODS * ACCURATE_SUBSTEPS)
    mujoco.mj_forward(model, data)
    return data

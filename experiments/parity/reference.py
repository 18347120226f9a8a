"""Reference environments of Gymnasium-Robotics, and the mapping of their joints to ours."""

from typing import Any

import jax
import mujoco
import numpy as np

from hgail_envs.fetch.arm import FetchEnv, FetchPhysics
from hgail_envs.fetch.reference import make_reference

_LONGER_THAN_ANY = 10_000  # steps
_NAMES = {
    "base_x": "robot0:slide0",
    "base_y": "robot0:slide1",
    "base_z": "robot0:slide2",
    "torso_lift": "robot0:torso_lift_joint",
    "right_finger": "robot0:r_gripper_finger_joint",
    "left_finger": "robot0:l_gripper_finger_joint",
    "cube": "object0:joint",
    "puck": "object0:joint",
}


def make_counterpart(env: FetchEnv) -> Any:
    """Returns the reference environment of a task, without wrappers and time limit."""
    return make_reference(str(env.reference), max_episode_steps=_LONGER_THAN_ANY).unwrapped


def joint_indices(model: mujoco.MjModel, theirs: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Returns the indices of our joints' positions, `[nq]`, and velocities, `[nv]`, in the reference."""
    qpos: list[int] = []
    qvel: list[int] = []
    for joint in range(model.njnt):
        name = model.joint(joint).name
        other = theirs.joint(_NAMES.get(name, f"robot0:{name}_joint"))
        free = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        qpos += range(int(other.qposadr[0]), int(other.qposadr[0]) + (7 if free else 1))
        qvel += range(int(other.dofadr[0]), int(other.dofadr[0]) + (6 if free else 1))
    return np.array(qpos), np.array(qvel)


def place(env: FetchEnv, reference: Any, qpos: np.ndarray, qvel: np.ndarray) -> FetchPhysics:
    """Returns the task's physics, `[N, ...]`, with the positions and velocities of `N` states of the reference."""
    of_qpos, of_qvel = joint_indices(env.model, reference.model)
    return jax.jit(jax.vmap(env.place))(np.float32(qpos[:, of_qpos]), np.float32(qvel[:, of_qvel]))


def gripper(reference: Any) -> np.ndarray:
    """Returns the position of the reference's gripper, `[3]`, metres."""
    # A step leaves the positions of one physics step before.
    mujoco.mj_kinematics(reference.model, reference.data)
    return reference.data.site("robot0:grip").xpos.copy()

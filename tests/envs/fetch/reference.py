"""Gymnasium-Robotics' tasks, as what ours are compared with."""

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np

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


def make_reference(env):
    """Returns the Gymnasium environment that a task is held to, without a time limit."""
    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make(env.reference, max_episode_steps=10_000).unwrapped


def joint_indices(model, theirs):
    """For each position and each velocity of our joints, its place in the reference's qpos and qvel."""
    qpos, qvel = [], []
    for joint in range(model.njnt):
        name = model.joint(joint).name
        other = theirs.joint(_NAMES.get(name, f"robot0:{name}_joint"))
        free = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        qpos += range(other.qposadr[0], other.qposadr[0] + (7 if free else 1))
        qvel += range(other.dofadr[0], other.dofadr[0] + (6 if free else 1))
    return np.array(qpos), np.array(qvel)

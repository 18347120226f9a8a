"""The environments that the tasks are held to."""

import numpy as np
from gymnasium_robotics.utils import mujoco_utils

from experiments.reference import make_reference


def test_the_reference_knows_joints_by_numbers():
    """Those of newer MuJoCos are no numbers, and it looks for a number among them."""
    env = make_reference("FetchReach-v4", max_episode_steps=7).unwrapped
    hinge = env.model.joint("robot0:elbow_flex_joint").type[0]
    kinds = mujoco_utils.mujoco.mjtJoint
    assert {type(kind) for kind in vars(kinds).values()} == {int}
    assert hinge == kinds.mjJNT_HINGE
    mujoco_utils.set_joint_qpos(env.model, env.data, "robot0:elbow_flex_joint", 0.5)
    assert np.isclose(env.data.joint("robot0:elbow_flex_joint").qpos[0], 0.5)

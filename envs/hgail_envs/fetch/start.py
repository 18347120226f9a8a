"""The arm's start in all Fetch scenes."""

import mujoco
import numpy as np

REFERENCE_SUBSTEPS = 20
"""Physics steps per action in the reference: 20 of 2 ms."""
BASE_X = 0.405
"""Position of the robot along x, metres, where a task has no other."""
START_HEIGHT = 0.2
"""Nominal height of the gripper's start above the table, metres, where a task has no other."""
DOWNWARD = np.array([1.0, 0.0, 1.0, 0.0])
"""Quaternion, not normalised, that points the gripper at the table."""

_BASE_Y = 0.48  # metres
_GRIPPER_OFFSET = np.array([-0.498, 0.005, -0.431])  # metres from the gripper's outstretched position to the table
_SETTLE_PERIODS = 10  # actions, as in the reference


def settle(
    model: mujoco.MjModel,
    base_x: float = BASE_X,
    start_height: float = START_HEIGHT,
    offset: np.ndarray | None = None,
) -> mujoco.MjData:
    """Brings the arm to its start, as the reference does: pulls the gripper there with C MuJoCo and lets it settle.

    Args:
      model: the scene.
      base_x: see `hgail_envs.fetch.arm.FetchEnv`.
      start_height: see `hgail_envs.fetch.arm.FetchEnv`.
      offset: `[3]`, displacement of the gripper from its start, metres.

    """
    data = mujoco.MjData(model)
    data.joint("base_x").qpos, data.joint("base_y").qpos = base_x, _BASE_Y
    mujoco.mj_forward(model, data)
    data.mocap_pos[0] = data.site("grip").xpos + _GRIPPER_OFFSET + [0.0, 0.0, start_height]
    if offset is not None:
        data.mocap_pos[0] += offset
    data.mocap_quat[0] = DOWNWARD
    mujoco.mj_step(model, data, nstep=_SETTLE_PERIODS * REFERENCE_SUBSTEPS)
    mujoco.mj_forward(model, data)
    return data

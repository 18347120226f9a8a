"""What the tests of engines share: random states of the grasp scene, and MuJoCo stepped by hand."""

import jax.numpy as jnp
import mujoco
import numpy as np

from hgail_envs.engines import Control, EngineState
from hgail_envs.robots.fetch import Fetch

PERIOD = 0.04
DOWNWARD = (1.0, 0.0, 1.0, 0.0)
ROBOT = Fetch("grasp")
MODEL, SETTLED = ROBOT.model, ROBOT.settle()


def random_states(count, seed=0):
    """Returns positions, velocities and controls of a moving arm, `[count, ...]`; every other one holds the cube."""
    rng = np.random.default_rng(seed)
    arm = slice(4, MODEL.nv - 6)  # the base never moves, and the cube comes last
    qpos, qvel = np.tile(SETTLED.qpos, (count, 1)), np.tile(SETTLED.qvel, (count, 1))
    held = SETTLED.site("grip").xpos
    cube = held + np.array([0.1, 0.1, 0.0]) + rng.uniform(-0.05, 0.05, (count, 3))
    cube[:, 2] = 0.425
    cube[::2] = held + rng.uniform(-0.004, 0.004, (len(cube[::2]), 3))
    qpos[:, -7:-4] = cube
    fingers = [MODEL.joint(f"{side}_finger").qposadr[0] for side in ("right", "left")]
    qpos[:, fingers] = 0.027
    qvel[:, arm] += rng.normal(size=qvel[:, arm].shape) * 0.1
    ctrl = rng.uniform(0.0, 0.03, (count, MODEL.nu))
    mocap = SETTLED.body("gripper").xpos + rng.uniform(-0.05, 0.05, (count, 3))
    control = np.concatenate([ctrl, mocap, np.tile(DOWNWARD, (count, 1))], axis=1)
    return tuple(array.astype(np.float32) for array in (qpos, qvel, control))


def engine_state(qpos, qvel):
    """Returns what an engine is given; a batch where positions and velocities are one."""
    batch = qpos.shape[:-1]
    return EngineState(
        qpos=jnp.asarray(qpos),
        qvel=jnp.asarray(qvel),
        warmstart=jnp.zeros((*batch, MODEL.nv)),
        sensordata=jnp.zeros((*batch, MODEL.nsensordata)),
        overflow=jnp.zeros(batch, bool),
    )


def engine_control(control):
    """Returns controls, positions and quaternions, `[..., nu + 7]`, as an engine takes them."""
    ctrl, position, turn = np.split(control, [MODEL.nu, MODEL.nu + 3], axis=-1)
    return Control(mocap_pos=position[..., None, :], mocap_quat=turn[..., None, :], ctrl=ctrl)


def step_by_hand(qpos, qvel, control, substeps, period=PERIOD):
    """Returns positions, velocities and sensors of each environment after an action, by `mujoco.mj_step`."""
    model = ROBOT.load()
    model.opt.timestep = period / substeps
    ends = []
    for one_qpos, one_qvel, one_control in zip(qpos, qvel, control, strict=True):
        data = mujoco.MjData(model)
        data.qpos, data.qvel, data.qacc_warmstart = one_qpos, one_qvel, 0.0
        data.ctrl, data.mocap_pos[0], data.mocap_quat[0] = np.split(one_control, [model.nu, model.nu + 3])
        for _ in range(substeps):
            mujoco.mj_step(model, data)
        ends.append((data.qpos.copy(), data.qvel.copy(), data.sensordata.copy()))
    return tuple(np.array(column).astype(np.float32) for column in zip(*ends, strict=True))

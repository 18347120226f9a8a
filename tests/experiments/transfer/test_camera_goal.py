import types

import numpy as np
import pytest

from experiments.transfer.camera_goal import camera_estimate


@pytest.mark.parametrize("task", ["reach", "grasp"])
def test_cameras_see_the_robot_s_own_frame(task):
    """The ball is put where the target is in the scene; what is seen comes back in the policy's frame."""
    offset, put = np.array([1.0, 2.0, 3.0]), []

    def localiser(model, data, rng, marker):
        put.append(marker)
        return np.array([0.1, 0.2, 0.3])

    robot = types.SimpleNamespace(task=task, offset=offset, model=None, data=None)
    estimate = camera_estimate(robot, localiser)(np.array([1.5, 2.5, 3.5]), np.random.default_rng(0))
    np.testing.assert_allclose(estimate, [1.1, 2.2, 3.3])
    if task == "reach":
        np.testing.assert_allclose(put[0], 0.5)
    else:
        assert put == [None]

import itertools

import numpy as np
import pytest

from experiments.transfer.robots.gymnasium_fetch import GymnasiumFetch
from experiments.transfer.robots.responses import FingerResponse, GripperResponse
from hgail_envs.fetch.arm import CONTROL_PERIOD
from tests.experiments.transfer.robots.motion import move


def test_responses_are_the_fetch_s():
    """The references alone, against the simulation they stand for."""
    theirs = move(GymnasiumFetch("grasp"), [[-1.0, 0.0, 0.0, 1.0]] * 3 + [[0.0, 0.0, 0.0, -1.0]] * 3)
    gripper, fingers = GripperResponse(theirs[0, :3]), FingerResponse(0.0)
    for number, (last, seen) in enumerate(itertools.pairwise(theirs), start=1):
        before = gripper.position
        target = gripper.lead(gripper.position, np.array([-1.0, 0.0, 0.0]) if number <= 3 else np.zeros(3))
        gripper.follow(target, CONTROL_PERIOD)
        goal = fingers.lead(fingers.gap, 1.0 if number <= 3 else -1.0)
        for _ in range(20):
            fingers.follow(goal, CONTROL_PERIOD / 20)
        np.testing.assert_allclose(gripper.position - before, seen[:3] - last[:3], atol=1e-3)
        assert fingers.gap == pytest.approx(seen[6], abs=8e-3)

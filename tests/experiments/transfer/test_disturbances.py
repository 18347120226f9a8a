import numpy as np
import pytest

from experiments.transfer.conditions import Conditions
from experiments.transfer.disturbances import DISTURBANCES
from hgail_envs.randomization import Randomization


@pytest.mark.parametrize("disturbance", DISTURBANCES.values(), ids=DISTURBANCES.keys())
def test_every_quantity_is_varied_from_nothing(disturbance):
    """On other robots, on this package's Fetch, or on both."""
    varied = []
    if disturbance.conditions:
        varied.append(([disturbance.conditions(value) for value in disturbance.values], Conditions()))
    if disturbance.sizes:
        varied.append(([Randomization(**disturbance.sizes(value)) for value in disturbance.values], Randomization()))
    assert varied
    for points, undisturbed in varied:
        assert undisturbed in points
        assert len(set(points)) == len(disturbance.values)


@pytest.mark.parametrize(("axis", "moved"), [("x", [0.03, 0, 0]), ("y", [0, 0.03, 0]), ("z", [0, 0, 0.03])])
def test_an_offset_moves_its_own_axis(axis, moved):
    estimate = DISTURBANCES[f"offset {axis}"].conditions(0.03).estimate
    np.testing.assert_allclose(estimate(np.zeros(3), np.random.default_rng(0)), moved)


def test_actions_are_disturbed_by_delay_and_stride():
    assert DISTURBANCES["delay"].conditions(2) == Conditions(delay=2)
    assert DISTURBANCES["stride"].conditions(1.5) == Conditions(stride=1.5)


def test_a_task_has_the_disturbances_that_can_change_anything():
    def of(task):
        return {name for name, disturbance in DISTURBANCES.items() if task in disturbance.tasks}

    about_object = {"mass", "size", "finger force", "finger speed", "hand opening"}
    in_sight = {"object offset", "object noise"}
    assert of("pick-and-place") == set(DISTURBANCES)
    assert of("grasp") == set(DISTURBANCES) - in_sight
    assert of("reach") == set(DISTURBANCES) - in_sight - about_object

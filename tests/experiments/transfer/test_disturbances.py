import numpy as np
import pytest

from experiments.transfer.disturbances import DISTURBANCES
from experiments.transfer.episode import Conditions


@pytest.mark.parametrize("disturbance", DISTURBANCES.values(), ids=DISTURBANCES.keys())
def test_every_quantity_is_varied_from_nothing(disturbance):
    conditions = [disturbance.conditions(value) for value in disturbance.values]
    assert Conditions() in conditions
    assert len(set(conditions)) == len(disturbance.values)


@pytest.mark.parametrize(("axis", "moved"), [("x", [0.03, 0, 0]), ("y", [0, 0.03, 0]), ("z", [0, 0, 0.03])])
def test_an_offset_moves_its_own_axis(axis, moved):
    estimate = DISTURBANCES[f"offset {axis}"].conditions(0.03).estimate
    np.testing.assert_allclose(estimate(np.zeros(3), np.random.default_rng(0)), moved)


def test_actions_are_disturbed_by_delay_and_stride():
    assert DISTURBANCES["delay"].conditions(2) == Conditions(delay=2)
    assert DISTURBANCES["stride"].conditions(1.5) == Conditions(stride=1.5)

import numpy as np
import pytest

from experiments.transfer.conditions import Conditions
from experiments.transfer.quantities import QUANTITIES
from hgail_envs.randomization import Randomization


@pytest.mark.parametrize("quantity", QUANTITIES.values(), ids=QUANTITIES.keys())
def test_every_quantity_is_varied_from_its_nominal_value(quantity):
    """On other robots, on this package's Fetch, or on both."""
    varied = []
    if quantity.conditions:
        varied.append(([quantity.conditions(value) for value in quantity.values], Conditions()))
    if quantity.sizes:
        varied.append(([Randomization(**quantity.sizes(value)) for value in quantity.values], Randomization()))
    assert varied
    for points, nominal in varied:
        assert nominal in points
        assert len(set(points)) == len(quantity.values)


@pytest.mark.parametrize(("axis", "moved"), [("x", [0.03, 0, 0]), ("y", [0, 0.03, 0]), ("z", [0, 0, 0.03])])
def test_an_offset_moves_its_own_axis(axis, moved):
    estimate = QUANTITIES[f"offset {axis}"].conditions(0.03).estimate
    np.testing.assert_allclose(estimate(np.random.default_rng(0))(np.zeros(3)), moved)


def test_delay_and_stride_are_conditions_of_actions():
    assert QUANTITIES["delay"].conditions(2) == Conditions(delay=2)
    assert QUANTITIES["stride"].conditions(1.5) == Conditions(stride=1.5)


def test_a_task_has_the_quantities_that_affect_it():
    def of(task):
        return {name for name, quantity in QUANTITIES.items() if task in quantity.tasks}

    about_object = {"mass", "size", "finger force", "finger speed", "hand opening"}
    in_sight = {"object offset", "object noise"}
    assert of("pick-and-place") == set(QUANTITIES)
    assert of("grasp") == set(QUANTITIES) - in_sight
    assert of("reach") == set(QUANTITIES) - in_sight - about_object

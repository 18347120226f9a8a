import numpy as np
import pytest

from experiments.localisation.error import errors, find
from experiments.localisation.localiser import Noise, detect_colour


def distances(studio, detect, marker, randomised, count=24):
    rng = np.random.default_rng(1)
    found = [find(studio.draw(rng, marker, randomised), detect) for _ in range(count)]
    return errors([one for one in found if one is not None], Noise(), rng), np.mean([one is None for one in found])


@pytest.mark.parametrize(
    ("name", "marker", "most"),
    [("colour", False, 4.0), ("colour", True, 1.5), ("network", False, 5.0), ("network", True, 5.0)],
)
def test_plain_scenes_are_localised_within_5_mm(studio, network, name, marker, most):
    millimetres, not_found = distances(studio, {"colour": detect_colour, "network": network}[name], marker, False)
    assert np.median(millimetres) <= most
    assert not_found <= (0.15 if marker else 0.05)  # some goals of reach are in the arm


def test_the_network_tells_the_target_from_red_clutter_better_than_colour_does(studio, network):
    far = {}
    for name, detect in {"colour": detect_colour, "network": network}.items():
        far[name] = np.mean(
            np.concatenate([distances(studio, detect, marker, True, 16)[0] for marker in (False, True)]) > 50
        )
    assert far["network"] <= 0.15
    assert far["colour"] >= far["network"] + 0.1

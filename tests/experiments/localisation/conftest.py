import pytest

from experiments.localisation.keypoint_network import load_detector
from experiments.localisation.paths import WEIGHTS
from experiments.localisation.random_scenes import Studio


@pytest.fixture(scope="session")
def studio(rendering):
    with Studio() as studio:
        yield studio


@pytest.fixture(scope="session")
def network():
    return load_detector(WEIGHTS)

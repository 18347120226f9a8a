import pytest

from experiments.localisation.keypoint_network import load_detector
from experiments.localisation.random_scenes import Studio
from experiments.paths import WEIGHTS


@pytest.fixture(scope="session")
def studio(rendering):
    with Studio() as studio:
        yield studio


@pytest.fixture(scope="session")
def network():
    return load_detector(WEIGHTS)

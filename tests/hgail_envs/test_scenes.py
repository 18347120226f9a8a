import numpy as np
import pytest

from hgail_envs.scenes import load_scene


@pytest.mark.parametrize("scene", ["fetch/reach", "fetch/grasp"])
def test_pictures_change_no_dynamics(scene):
    physics, pictures = load_scene(scene), load_scene(scene, visual=True)
    assert pictures.ngeom > physics.ngeom
    np.testing.assert_array_equal(physics.body_mass, pictures.body_mass)
    np.testing.assert_array_equal(physics.body_inertia, pictures.body_inertia)
    assert physics.npair == pictures.npair

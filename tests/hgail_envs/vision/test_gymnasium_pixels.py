"""Gymnasium environments whose observations have pictures."""

import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import hgail_envs  # noqa: F401  (registers the tasks)

pytestmark = pytest.mark.usefixtures("rendering")


def test_a_single_environment_shows_its_first_state_and_the_one_after_an_action():
    env = gymnasium.make("hgail_envs/FetchPush-v0", cameras=["front", "wrist"], picture_size=16)
    check_env(env.unwrapped, skip_render_check=True)
    first, _ = env.reset(seed=0)
    assert first["pixels"].shape == (2, 16, 16, 3) and first["pixels"].dtype == np.uint8
    assert env.observation_space.contains(first)
    after, *_ = env.step(np.array([1.0, 0.0, 0.0, 0.0]))
    assert (after["pixels"] != first["pixels"]).any()
    again, _ = env.reset(seed=0)
    np.testing.assert_array_equal(again["pixels"], first["pixels"])


def test_rows_of_a_vector_are_its_environments_and_it_can_be_pickled():
    vector = gymnasium.make_vec("hgail_envs/FetchPush-v0", num_envs=2, cameras=["front"], picture_size=32)
    pixels = vector.reset(seed=3)[0]["pixels"]
    other = pickle.loads(pickle.dumps(vector))
    single = gymnasium.make("hgail_envs/FetchPush-v0", cameras=["front"], picture_size=32)
    for row in range(2):
        np.testing.assert_array_equal(single.reset(seed=3 + row)[0]["pixels"], pixels[row])
    assert (pixels[0] != pixels[1]).any()
    np.testing.assert_array_equal(other.reset(seed=3)[0]["pixels"], pixels)


def test_other_observations_have_no_pictures_and_an_unknown_camera_is_refused():
    assert "pixels" not in gymnasium.make("hgail_envs/FetchPush-v0").observation_space.spaces
    with pytest.raises(ValueError, match="scene push has no camera 'nose'"):
        gymnasium.make("hgail_envs/FetchPush-v0", cameras=["nose"])
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(ValueError, match="picture_size is 32, and there are no cameras"):
            make("hgail_envs/FetchPush-v0", picture_size=32)

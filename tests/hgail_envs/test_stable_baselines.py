"""The adapter to stable-baselines3."""

import numpy as np
import pytest

import hgail_envs
from hgail_envs.vector import GoalVectorEnv


@pytest.fixture
def stable_baselines():
    pytest.importorskip("stable_baselines3", reason="needs stable-baselines3 and PyTorch")
    from hgail_envs import stable_baselines

    return stable_baselines


def test_the_adapter_has_the_vector_environment_s_episodes(stable_baselines):
    task = hgail_envs.make("point")
    plain, env = GoalVectorEnv(task, 2), stable_baselines.GoalVecEnv(GoalVectorEnv(task, 2, autoreset_mode="SameStep"))
    env.seed(3)
    first, (expected, _) = env.reset(), plain.reset(seed=3)
    np.testing.assert_array_equal(first["desired_goal"], expected["desired_goal"])
    for step in range(task.episode_length):
        actions = np.full((2, 3), 0.01 * step, np.float32)
        observation, reward, done, infos = env.step(actions)
        expected, expected_reward, *_ = plain.step(actions)
        np.testing.assert_array_equal(reward, expected_reward)
        assert done.tolist() == [step == task.episode_length - 1] * 2
    following, *_ = plain.step(actions)
    for index in range(2):
        for name in expected:
            np.testing.assert_array_equal(infos[index]["terminal_observation"][name], expected[name][index])
            np.testing.assert_array_equal(observation[name][index], following[name][index])
        assert infos[index]["TimeLimit.truncated"] and infos[index]["is_success"] == (expected_reward[index] == 0.0)
    goals = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(
        env.env_method("compute_reward", np.zeros((2, 3)), goals, {}, indices=[0])[0], [0, -1]
    )


def test_the_adapter_refuses_another_autoreset(stable_baselines):
    with pytest.raises(ValueError, match="needs 'SameStep'"):
        stable_baselines.GoalVecEnv(GoalVectorEnv(hgail_envs.make("point"), 1))


def test_the_adapter_renders_the_vector_environment_s_pictures(stable_baselines, rendering):
    vector = GoalVectorEnv(hgail_envs.make("reach", impl="c"), 2, autoreset_mode="SameStep", render_mode="rgb_array")
    env = stable_baselines.GoalVecEnv(vector)
    env.reset()
    height, width, _ = vector.render()[0].shape
    picture = env.render()
    assert picture.shape in [(2 * height, width, 3), (height, 2 * width, 3)]
    assert picture.std() > 10.0
    assert env.metadata["render_fps"] == 25
    env.close()

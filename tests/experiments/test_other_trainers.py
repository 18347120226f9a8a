"""Trainers of others on the tasks: stable-baselines3's adapter and learning, and the example in one file."""

import gymnasium
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


def test_a_test_on_push_counts_the_cubes_that_end_at_their_goals():
    """Under a policy that keeps still these are the cubes that start there."""
    from experiments.other_trainers import TEST_ENVS, make_test

    seen = []

    def keep_still(observation):
        seen.append(observation)
        return np.zeros((TEST_ENVS, 4), np.float32)

    success = make_test("push", substeps=8)(keep_still)
    start = np.linalg.norm(seen[0]["observation"][:, 9:12] - seen[0]["desired_goal"][:, :3], axis=-1)
    assert len(seen) == 50
    assert success == np.mean(start < 0.05)
    assert 0.0 < success < 1.0


@pytest.mark.slow
def test_stable_baselines3_learns_reach(stable_baselines):
    from experiments.other_trainers import measure, sb3_sac_her

    assert measure(sb3_sac_her, 20_000)["success"] >= 0.98


@pytest.mark.slow
def test_the_example_in_one_file_learns_reach():
    from experiments.other_trainers import measure
    from experiments.sac_her import train

    assert measure(train, 20_000)["success"] >= 0.98


def test_the_example_s_hindsight_has_the_environment_s_rewards():
    """Relabelled or not, each reward is the goal test of the task, and each goal of the same episode."""
    import jax

    from experiments import sac_her

    env = gymnasium.make_vec("hgail_envs/Point-v0", num_envs=1)
    rng, episodes = np.random.default_rng(0), 4
    walk = np.cumsum(rng.normal(0.0, 0.02, (episodes, sac_her.STEPS + 1, 3)), axis=1).astype(np.float32)
    numbered = np.broadcast_to(np.arange(episodes, dtype=np.float32)[:, None, None], walk.shape)
    buffer = {
        "observation": np.concatenate([walk, numbered], -1),
        "achieved_goal": walk,
        "desired_goal": np.full_like(walk, 9.0),
        "action": walk,
    }
    seen, _, reward, following = sac_her.sample(buffer, 3, jax.random.key(0))
    seen, following = np.asarray(seen), np.asarray(following)
    np.testing.assert_array_equal(reward, env.unwrapped.compute_reward(following[:, :3], seen[:, 6:]))
    assert set(seen[:, 3]) == {0.0, 1.0, 2.0}
    kept = (seen[:, 6:] == 9.0).all(axis=1)
    assert 0.1 < kept.mean() < 0.3
    for row in seen[~kept]:
        states = walk[int(row[3])]
        now = np.flatnonzero((states == row[:3]).all(axis=1))[0]
        assert np.flatnonzero((states == row[6:]).all(axis=1))[0] > now

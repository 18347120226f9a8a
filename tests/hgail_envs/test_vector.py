"""The vector environment against the task; against Gymnasium's own vectorisation it is in `test_gymnasium`."""

import copy
import pickle

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hgail_envs
from hgail_envs.point import Point
from hgail_envs.vector import GoalVectorEnv

TASK = hgail_envs.make("point")
NUM_ENVS = 3


def same(left, right):
    assert left.keys() == right.keys()
    for name in left:
        np.testing.assert_allclose(left[name], right[name], atol=1e-6)
        assert left[name].dtype == right[name].dtype == np.float32


def test_an_episode_is_the_task_s():
    vector = GoalVectorEnv(TASK, NUM_ENVS)
    observation, _ = vector.reset(seed=11)
    states = [TASK.reset(jax.random.split(jax.random.key(11 + index))[1]) for index in range(NUM_ENVS)]
    action = np.array([0.4, -0.2, 2.0], np.float32)
    for _ in range(4):
        np.testing.assert_allclose(
            np.concatenate([observation["observation"], observation["desired_goal"]], axis=1),
            [state.obs for state in states],
            atol=1e-6,
        )
        observation, reward, *_ = vector.step(np.tile(action, (NUM_ENVS, 1)))
        states = [TASK.step(state, jnp.asarray(action)) for state in states]
        np.testing.assert_array_equal(reward, [state.reward for state in states])


def test_episodes_differ_and_a_reset_continues_them():
    vector = GoalVectorEnv(TASK, NUM_ENVS)
    goals = [vector.reset(seed=1)[0], vector.reset()[0], vector.reset(seed=1)[0], vector.reset()[0]]
    first, second, again, later = (goal["desired_goal"] for goal in goals)
    assert not np.isclose(first, second).any()
    assert not np.isclose(first[0], first[1]).any()
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(second, later)
    np.testing.assert_array_equal(vector.reset(seed=[1, 2, 3])[0]["desired_goal"], first)


class Keyed(Point):
    """A start and a goal made of whatever can be drawn from their keys, and from those that these are split into."""

    feature_size = goal_size = 7

    def draws(self, rng):
        keys = [rng, *jax.random.split(rng)]
        keys += [key for half in keys[1:] for key in jax.random.split(half)]
        return jnp.stack([jax.random.uniform(key) for key in keys])

    def reset_physics(self, rng):
        return self.draws(rng)

    def sample_goal(self, rng, physics):
        return self.draws(rng)


def test_no_key_is_used_in_two_episodes():
    """Nor one that an episode's keys are split into, where a task's reset splits them further."""
    vector, seen = GoalVectorEnv(Keyed(), NUM_ENVS), []
    for episode in range(4):
        observation, _ = vector.reset(seed=0) if episode == 0 else vector.reset()
        seen += [observation["observation"], observation["desired_goal"]]
    assert len(np.unique(seen)) == np.size(seen) == 4 * NUM_ENVS * 14


def test_the_episode_after_a_time_limit_is_that_after_a_reset():
    vector, other = GoalVectorEnv(TASK, NUM_ENVS), GoalVectorEnv(TASK, NUM_ENVS)
    for one in (vector, other):
        one.reset(seed=4)
    for _ in range(TASK.episode_length + 1):
        observation, *_ = vector.step(np.zeros((NUM_ENVS, 3)))
    same(observation, other.reset()[0])


def test_rewards_of_relabelled_goals():
    vector = GoalVectorEnv(TASK, NUM_ENVS)
    achieved = np.zeros((2, 3), np.float32)
    desired = np.array([[0.0, 0.0, 0.049], [0.0, 0.0, 0.051]], np.float32)
    np.testing.assert_array_equal(vector.compute_reward(achieved, desired, {}), [0.0, -1.0])
    np.testing.assert_array_equal(vector.compute_reward(achieved.tolist(), desired.tolist()), [0.0, -1.0])
    for shape in ((), (1,), (5,), (2, 3), (7, 1), (0,)):  # of a batch; six, seven and eight share a program
        goals = np.random.default_rng(0).uniform(-0.06, 0.06, (2, *shape, 3))
        expected = np.where(np.linalg.norm(goals[0] - goals[1], axis=-1) <= TASK.success_threshold, 0.0, -1.0)
        np.testing.assert_array_equal(vector.compute_reward(*goals), expected)
    assert vector._success._cache_size() == 3  # of 1, 2 and 8
    for achieved in (np.zeros(4), np.zeros((2, 4)), np.zeros((3, 3))):
        with pytest.raises(ValueError, match=r"achieved goals have the shape .*; desired ones \(2, 3\), of 3 numbers"):
            vector.compute_reward(achieved, desired)


def test_misuse_is_refused():
    with pytest.raises(ValueError, match="num_envs is 0"):
        GoalVectorEnv(TASK, 0)
    few = Point()
    few.max_worlds = 2
    GoalVectorEnv(few, 2)
    with pytest.raises(ValueError, match="num_envs is 3; the task was made for 2"):
        GoalVectorEnv(few, 3)
    vector = GoalVectorEnv(TASK, NUM_ENVS)
    with pytest.raises(gymnasium.error.ResetNeeded):
        vector.step(np.zeros((NUM_ENVS, 3)))
    with pytest.raises(ValueError, match="2 seeds for 3"):
        vector.reset(seed=[1, 2])
    vector.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(3,\)"):
        vector.step(np.zeros(3))


def test_what_is_no_vector_environment_is_refused():
    with pytest.raises(ValueError, match="num_envs is '3'; it must be an integer"):
        GoalVectorEnv(TASK, "3")
    with pytest.raises(TypeError, match="env is 'point'; it must be a GoalEnv"):
        GoalVectorEnv("point", 3)


@pytest.mark.parametrize("seed", [1.5, "012", [0, 1, 2.5], [True, 1, 2]])
def test_seeds_are_integers(seed):
    with pytest.raises(ValueError, match=r"seed is .*; it must be an integer"):
        GoalVectorEnv(TASK, NUM_ENVS).reset(seed=seed)


@pytest.mark.parametrize("seed", [-1, 2**32, [0, 1, -1]])
def test_seeds_have_a_range(seed):
    with pytest.raises(ValueError, match=r"seed is .*; it must be at (least 0|most 4294967295)"):
        GoalVectorEnv(TASK, NUM_ENVS).reset(seed=seed)


def test_seeds_may_be_an_array():
    first, second = GoalVectorEnv(TASK, NUM_ENVS), GoalVectorEnv(TASK, NUM_ENVS)
    same(first.reset(seed=np.arange(4, 7))[0], second.reset(seed=np.int64(4))[0])


def test_options_that_nobody_knows_are_not_ignored():
    vector = GoalVectorEnv(TASK, NUM_ENVS)
    with pytest.raises(ValueError, match="options are 'reset_mask'; there are none"):
        vector.reset(options={"reset_mask": np.array([True, False, False])})
    vector.reset(options={})


@pytest.mark.parametrize("action", [np.nan, np.inf, "up"])
def test_actions_are_finite_numbers(action):
    vector = GoalVectorEnv(TASK, NUM_ENVS)
    vector.reset(seed=0)
    with pytest.raises(ValueError, match="not all actions are finite numbers"):
        vector.step(np.full((NUM_ENVS, 3), action))


@pytest.mark.parametrize("duplicate", [lambda value: pickle.loads(pickle.dumps(value)), copy.deepcopy])
def test_a_pickled_or_copied_one_continues_within_the_episode_by_itself(duplicate):
    ours, action = GoalVectorEnv(Point(), NUM_ENVS), np.ones((NUM_ENVS, 3))
    assert duplicate(ours).num_envs == NUM_ENVS  # before it is reset
    ours.reset(seed=7)
    ours.step(action)
    theirs = duplicate(ours)
    for _ in range(Point.episode_length + 1):  # with the reset
        (observation, *_), (other, *_) = ours.step(action), theirs.step(action)
        same(observation, other)
    theirs.step(action)
    ours.env.success_threshold = 0.5
    assert theirs.env.success_threshold == Point.success_threshold

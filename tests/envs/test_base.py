"""What every task has of `GoalEnv`, on the smallest tasks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.point import Point


class Told(Point):
    """The point at a random start; the third number of a goal says what it is drawn for."""

    MEASURED, LEARNT_FROM, TRACKED = 0.1, 0.2, 0.05

    def reset_physics(self, rng):
        return jax.random.uniform(rng, (3,), maxval=0.01)

    def sample_goal(self, rng, physics):
        return super().sample_goal(rng, physics).at[2].set(self.MEASURED)

    def sample_exploration_goal(self, rng, physics):
        return super().sample_goal(rng, physics).at[2].set(self.LEARNT_FROM)

    def track_goal(self, desired, physics, exploring):
        return desired.at[0].set(jnp.where(exploring, physics[0], self.TRACKED))


@pytest.mark.parametrize("task", ["point", "reach"])
def test_an_observation_is_features_and_goal_and_is_rebuilt_for_another(task):
    env = envs.make(task)
    state = jax.jit(env.reset)(jax.random.key(0))
    assert state.obs.shape == (env.observation_size,) == (env.feature_size + 3,)
    np.testing.assert_array_equal(state.obs[: env.feature_size], state.info["observation"])
    np.testing.assert_array_equal(state.obs[env.feature_size :], state.info["desired_goal"])
    np.testing.assert_array_equal(state.obs[:3], state.info["achieved_goal"])
    other = jnp.array([1.0, 2.0, 3.0])
    rebuilt = env.goal_observation(state.info["observation"], other)
    np.testing.assert_array_equal(rebuilt, [*state.obs[: env.feature_size], 1.0, 2.0, 3.0])


def test_success_is_within_the_threshold():
    env = envs.make("point")
    achieved = jnp.array([[0.0, 0.0, 0.049], [0.0, 0.0, 0.051], [0.04, 0.04, 0.0]])
    np.testing.assert_array_equal(env.success(achieved, jnp.zeros(3)), [True, False, False])


def test_rewards_and_outcome_are_those_of_where_the_step_leads():
    env = Point()
    state = env.reset(jax.random.key(0))
    assert state.done == 0.0
    goal = state.info["desired_goal"]
    for position, reward in ((goal + jnp.array([0.0, 0.04, 0.0]), 0.0), (goal - jnp.array([0.0, 0.06, 0.0]), -1.0)):
        end = env.step(state.replace(pipeline_state=position), jnp.zeros(3))
        assert end.reward == reward
        measured = env.outcome(end, end)
        assert measured.success == measured.achieved == measured.success_l1 == reward + 1.0
        np.testing.assert_allclose(measured.distance_l2, jnp.linalg.norm(position - goal), rtol=1e-5)
    diagonal = env.step(state.replace(pipeline_state=goal + 0.025), jnp.zeros(3))
    measured = env.outcome(diagonal, diagonal)  # 43 mm away, but 75 mm as the sum over the axes
    assert (measured.success, measured.success_l1) == (1.0, 0.0)
    np.testing.assert_allclose(measured.distance_l1, 0.075, rtol=1e-4)


def test_actions_are_clipped():
    env = envs.make("point")
    state = env.reset(jax.random.key(0))
    for action, moved in ((9.0, 0.03), (-9.0, -0.03), (0.5, 0.015)):
        np.testing.assert_allclose(env.step(state, jnp.full(3, action)).info["achieved_goal"], moved, rtol=1e-6)


@pytest.mark.parametrize("traced", [False, True])
@pytest.mark.parametrize("exploring", [False, True])
def test_an_episode_has_goals_to_learn_from_where_it_explores(exploring, traced):
    env, key = Told(), jax.random.key(3)
    reset = jax.jit(env.reset) if traced else env.reset
    state = reset(key, exploring)
    expected = Told.LEARNT_FROM if exploring else Told.MEASURED
    for _ in range(3):
        assert state.info["exploring"] == exploring
        assert state.info["desired_goal"][2] == np.float32(expected)
        start = state.info["achieved_goal"][0] if exploring else Told.TRACKED
        np.testing.assert_allclose(state.info["desired_goal"][0], start, rtol=1e-6)
        state = env.step(state, jnp.ones(3))


def test_an_episode_is_measured_unless_it_is_said_to_explore():
    assert not Told().reset(jax.random.key(0)).info["exploring"]


def test_start_and_goal_are_drawn_from_keys_of_their_own():
    """A start and a goal, both uniform, would be proportional if they shared a key."""
    state = jax.vmap(Told().reset)(jax.random.split(jax.random.key(0), 2000))
    start, goal = (np.asarray(state.info[name])[:, 1] for name in ("achieved_goal", "desired_goal"))
    assert start.std() > 0.002
    assert abs(np.corrcoef(start, goal)[0, 1]) < 0.1


def test_a_task_of_one_s_own_learns_on_the_goals_that_it_is_measured_by_unless_it_has_others():
    key = jax.random.key(5)
    goals = [Point().reset(key, exploring).info["desired_goal"] for exploring in (False, True)]
    np.testing.assert_array_equal(*goals)

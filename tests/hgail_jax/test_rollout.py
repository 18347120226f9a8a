"""Roll-outs against loops, what breaks down in them, and how they are measured."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hgail_envs.base import EpisodeMetrics
from hgail_envs.point import Point
from hgail_envs.tasks.reach import Reach
from hgail_jax import rollout
from hgail_jax.evaluate import evaluate, mean_outcome
from hgail_jax.rollout import Detour
from tests.hgail_jax.line import LENGTH, Line, trajectory

NUM_ENVS = 16


class Lifted(Point):
    """The point, measured where three further steps bring it; it overflows where its x is negative then."""

    lift_test_steps = 3

    def lift_test_action(self, action):
        return 0.5 * action - 0.4

    def outcome(self, end, lifted):
        return self.measure(lifted.info["achieved_goal"], end.info["desired_goal"])

    def overflow(self, physics):
        return physics[0] < 0.0


def passing(observation, rng):
    """Goes, at first at full speed, for a point beside the goal."""
    del rng
    position, goal = observation[:, :3], observation[:, 3:]
    return 10.0 * (goal - position) + 5.0 * goal[:, [1, 2, 0]], -jnp.square(observation).sum(axis=-1)


def roll_out(rng, lift_test):
    return rollout(Lifted(), passing, rng, NUM_ENVS, lift_test=lift_test)


built_in, traced = jax.jit(roll_out, static_argnums=1), jax.jit(roll_out)


@pytest.mark.parametrize("lift_test", [False, True, jnp.array(False), jnp.array(True)])
def test_a_roll_out_is_the_loop_over_its_steps_and_its_lift_test(lift_test):
    episodes = (built_in if isinstance(lift_test, bool) else traced)(jax.random.key(0), lift_test)
    goal = np.asarray(episodes.desired[0], np.float64)
    assert len(np.unique(goal)) == goal.size
    position = np.zeros((NUM_ENVS, 3))
    for step in range(50):
        np.testing.assert_allclose(episodes.features[step], position, atol=1e-5)
        np.testing.assert_array_equal(episodes.achieved[step], episodes.features[step])
        np.testing.assert_array_equal(episodes.desired[step], goal)
        action = 10.0 * (goal - position) + 5.0 * goal[:, [1, 2, 0]]
        np.testing.assert_allclose(episodes.action[step], action, atol=1e-4)
        np.testing.assert_allclose(episodes.noted[step], -(position**2 + goal**2).sum(axis=-1), atol=1e-5)
        position = position + 0.03 * np.clip(action, -1.0, 1.0)
        reached = np.linalg.norm(position - goal, axis=-1) <= 0.05
        np.testing.assert_array_equal(episodes.reward[step], np.where(reached, 0.0, -1.0))
    np.testing.assert_allclose(episodes.features[50], position, atol=1e-5)
    assert len(episodes.features) == len(episodes.reward) + 1 == 51
    changes = np.diff(episodes.reward, axis=0)
    assert changes.max() == -changes.min() == 1.0  # goals are reached, and left again
    before = position
    for _ in range(3 if lift_test else 0):
        action = 0.5 * action - 0.4
        position = position + 0.03 * np.clip(action, -1.0, 1.0)
    np.testing.assert_allclose(episodes.outcome.distance_l1, np.abs(position - goal).sum(axis=-1), atol=1e-5)
    np.testing.assert_array_equal(episodes.overflow, position[:, 0] < 0.0)
    assert ((position[:, 0] < 0.0) != (before[:, 0] < 0.0)).any() == bool(lift_test)


side_by_side = jax.jit(jax.vmap(roll_out, in_axes=(0, None)))


@pytest.mark.parametrize("lift_test", [False, True])
def test_seeds_side_by_side_roll_out_as_alone(lift_test):
    keys = jax.random.split(jax.random.key(1), 3)
    together = jax.device_get(side_by_side(keys, jnp.array(lift_test)))
    for seed, key in enumerate(keys):
        alone, of_seed = traced(key, jnp.array(lift_test)), jax.tree.map(lambda leaf, seed=seed: leaf[seed], together)
        jax.tree.map(lambda *leaves: np.testing.assert_allclose(*leaves, atol=1e-5), alone, of_seed)


def test_every_step_of_every_episode_has_noise_of_its_own():
    def noise(observation, rng):
        return jax.random.normal(rng, (len(observation), 3)), jnp.zeros(len(observation))

    action = np.asarray(jax.jit(lambda rng: rollout(Lifted(), noise, rng, NUM_ENVS).action)(jax.random.key(0)))
    assert len(np.unique(action)) > 0.999 * action.size


class Fragile(Lifted):
    """The point, whose simulation breaks down where only the lift test brings it."""

    def step_physics(self, physics, action):
        following = super().step_physics(physics, action)
        return jnp.where(following[1] > 1.51, jnp.nan, following)

    def lift_test_action(self, action):
        return action

    def outcome(self, end, lifted):
        return self.measure(end.info["achieved_goal"], end.info["desired_goal"])


@pytest.mark.parametrize("lift_test", [False, True])
def test_an_episode_whose_simulation_breaks_down_in_the_lift_test_is_not_valid(lift_test):
    def policy(observation, rng):
        return jnp.where(observation[:, 4:5] > 0.0, jnp.array([0.0, 1.0, 0.0]), 0.0), jnp.zeros(len(observation))

    episodes = jax.jit(lambda rng: rollout(Fragile(), policy, rng, NUM_ENVS, lift_test=lift_test))(jax.random.key(2))
    far = np.asarray(episodes.achieved[-1, :, 1]) > 1.0
    if lift_test:
        assert 0 < episodes.valid.sum() < NUM_ENVS
        np.testing.assert_array_equal((np.asarray(episodes.desired[0]) == 0.0).all(axis=-1), ~episodes.valid)
        assert not far.any()
    else:
        assert episodes.valid.all()
        assert 0 < far.sum() < NUM_ENVS


class Refused(Reach):
    """Reach, where MuJoCo is given a velocity that it warns of once the gripper is left of its start."""

    episode_length = 6

    def step_physics(self, physics, action):
        left = physics.gripper_position[1] > self.initial_gripper_position[1] + 0.01
        velocity = physics.qvel.at[0].add(jnp.where(left, 1e12, 0.0))
        return super().step_physics(physics.replace(qvel=velocity), action)


def test_an_episode_that_mujoco_warns_of_is_not_valid_and_leaves_the_others_alone():
    def straight(observation, rng):
        action = jnp.pad(10.0 * (observation[:, -3:] - observation[:, :3]), ((0, 0), (0, 1)))
        return action, jnp.zeros(len(action))

    plain = type("Plain", (Reach,), {"episode_length": Refused.episode_length})
    whole, broken = (
        jax.jit(lambda rng, env=env: rollout(env, straight, rng, NUM_ENVS))(jax.random.key(0))
        for env in (plain(impl="c", substeps=4), Refused(impl="c", substeps=4))
    )
    assert whole.valid.all()
    farthest = np.asarray(whole.achieved)[:-1, :, 1].max(axis=0)
    np.testing.assert_array_equal(broken.valid, farthest <= np.asarray(whole.achieved)[0, :, 1] + 0.01)
    assert 0 < broken.valid.sum() < NUM_ENVS
    for name in ("features", "achieved", "action", "reward"):
        ours, theirs = (np.asarray(getattr(episodes, name)) for episodes in (broken, whole))
        np.testing.assert_array_equal(ours[:, broken.valid], theirs[:, broken.valid])
        assert (ours[:, ~broken.valid] == 0.0).all()


def test_a_detour_is_pursued_for_its_steps_and_measured_by_the_own_goal():
    """Half of the episodes go for a goal beside their own at first; the others, and the end, are as without it."""
    rng, half = jax.random.key(0), np.arange(NUM_ENVS) % 2
    plain = jax.jit(lambda: rollout(Lifted(), passing, rng, NUM_ENVS))()
    own = np.asarray(plain.desired[0])
    until = np.where(half, 3 + np.arange(NUM_ENVS), 0)
    beside = np.float32(np.add(own, [0.0, 0.0, 0.06]))
    led = jax.jit(lambda detour: rollout(Lifted(), passing, rng, NUM_ENVS, detour=detour))(
        Detour(jnp.asarray(beside), jnp.asarray(until))
    )
    position = np.zeros((NUM_ENVS, 3))
    for step in range(51):
        goal = np.where((step < until)[:, None], beside, own)
        np.testing.assert_allclose(led.desired[step], goal, atol=1e-6)
        np.testing.assert_allclose(led.features[step], position, atol=1e-4)
        if step:
            reached = np.linalg.norm(position - goal, axis=-1) <= 0.05
            np.testing.assert_array_equal(led.reward[step - 1], np.where(reached, 0.0, -1.0))
        position = position + 0.03 * np.clip(10.0 * (goal - position) + 5.0 * goal[:, [1, 2, 0]], -1.0, 1.0)
    np.testing.assert_array_equal(led.desired[:, ~half.astype(bool)], plain.desired[:, ~half.astype(bool)])
    np.testing.assert_allclose(led.outcome.distance_l2, np.linalg.norm(led.achieved[50] - own, axis=-1), atol=1e-5)


# Episodes that break down, and outcomes


class Breaking(Line):
    """The line; it breaks down beyond 40 and overflows beyond 30, and its lift test continues with half the action."""

    lift_test_steps = 2

    def step_physics(self, physics, action):
        following = physics + 10.0 * action
        return jnp.where(following > 40.0, jnp.nan, following)

    def overflow(self, physics):
        return physics[0] > 30.0

    def lift_test_action(self, action):
        return 0.5 * action

    def outcome(self, end, lifted):
        return self.measure(lifted.info["achieved_goal"][:1], end.info["achieved_goal"][:1])


def play(env, policy, episodes, seed=0, **options):
    return jax.jit(lambda rng: rollout(env, policy, rng, episodes, **options))(jax.random.key(seed))


def steady(speeds):
    speeds = jnp.asarray(speeds)

    def policy(observation, rng):
        del rng
        return speeds[:, None], observation[:, 0]

    return policy


@jax.jit
def break_down(rng, training_goals, lift_test):
    return rollout(Breaking(), steady([0.1, 0.45, 0.6, 0.9, -0.9, 0.0]), rng, 6, training_goals, lift_test=lift_test)


def test_episodes_that_break_down_are_blank_and_counted():
    """The fourth breaks down, the fifth leaves the bounds, the third breaks down in the lift test alone."""
    for lift_test, valid in ((False, [1, 1, 1, 0, 0, 1]), (True, [1, 1, 0, 0, 0, 1])):
        given = break_down(jax.random.key(0), False, lift_test)
        valid = np.array(valid, bool)
        np.testing.assert_array_equal(given.valid, valid)
        for name in ("features", "achieved", "desired", "action", "noted", "reward"):
            leaf = np.asarray(getattr(given, name))
            assert (leaf[:, ~valid] == 0).all()
            assert np.isfinite(leaf).all()
        start = np.asarray(given.features[0, :, 0])
        assert len(np.unique(start[valid])) == valid.sum()
        for episode in np.flatnonzero(valid):
            path = start[episode] + 10.0 * float(given.action[0, episode, 0]) * np.arange(LENGTH + 1)
            np.testing.assert_allclose(given.features[:, episode, 0], path, rtol=1e-4)
            np.testing.assert_allclose(given.noted[:, episode], path[:-1], rtol=1e-4)
        further = np.array([0.75, 3.375, 4.5, 0, 0, 0]) * lift_test * valid
        np.testing.assert_allclose(given.outcome.distance_l1, further, atol=1e-4)
        np.testing.assert_array_equal(
            given.overflow, [0, lift_test, not lift_test, 0, 0, 0]
        )  # nothing overflows once broken


@pytest.mark.parametrize("training_goals", [False, True])
def test_only_episodes_to_learn_from_have_training_goals(training_goals):
    given = break_down(jax.random.key(1), training_goals, False)
    goal = [-1.0, 1.0] if training_goals else [1.0, 0.0]
    np.testing.assert_array_equal(given.desired[:, :3], np.broadcast_to(goal, (LENGTH + 1, 3, 2)))


def test_a_roll_out_is_measured_without_training_goals_or_lift_test_unless_asked():
    given = play(Breaking(), steady([0.1]), 1)
    np.testing.assert_array_equal(given.desired[0, 0], [1.0, 0.0])
    assert given.outcome.distance_l1[0] == 0.0


def test_observations_may_reach_the_limit_and_no_further():
    class Far(Line):
        def reset_physics(self, rng):
            return jnp.zeros(1)

        def step_physics(self, physics, action):
            return physics + 0.25 * jnp.round(4.0 * action) + 25.0 * (physics == 0.25)

    class Wide(Far):
        observation_limit = 25.25

    policy = steady([0.25])
    assert play(Far(), policy, 1).valid.all()
    assert not play(Wide(), policy, 1).valid.any()

    class Still(Line):
        observation_limit = 1.0

        def reset_physics(self, rng):
            return jnp.ones(1)

    assert play(Still(), steady([0.0]), 1).valid.all()
    assert not play(Still(), steady([-1.0]), 1).valid.any()


def test_an_action_or_outcome_that_is_not_finite_spoils_its_episode_alone():
    class Unmeasured(Line):
        def outcome(self, end, lifted):
            return self.measure(end.obs, end.obs).replace(distance_l2=1.0 / jnp.where(end.obs[0] > 2.0, 0.0, 1.0))

    given = play(Unmeasured(), steady([0.0, 1.0, 0.0]), 3)
    np.testing.assert_array_equal(given.valid, [True, False, True])
    np.testing.assert_array_equal(given.outcome.distance_l2, [1.0, 0.0, 1.0])
    given = play(Line(), steady([0.0, jnp.inf, 0.0]), 3)
    np.testing.assert_array_equal(given.valid, [True, False, True])


def test_starts_are_drawn_apart_from_actions():
    def policy(observation, rng):
        return jax.random.uniform(rng, (len(observation), 1)), jnp.zeros(len(observation))

    given = play(Line(), policy, 50)
    drawn = np.concatenate([np.asarray(given.features[:1]), given.action], axis=0)[..., 0]
    assert len(np.unique(drawn)) > 0.99 * drawn.size
    assert np.abs(np.corrcoef(drawn) - np.eye(len(drawn))).max() < 0.5
    assert not np.array_equal(play(Line(), policy, 50, 1).action, given.action)


def test_the_number_of_episodes_is_at_least_1():
    with pytest.raises(ValueError, match="num_envs"):
        play(Line(), steady([0.0]), 0)


def test_the_physics_of_a_task_may_hold_a_key():
    class Shaken(Line):
        def reset_physics(self, rng):
            return jnp.zeros(1), rng

        def step_physics(self, physics, action):
            rng, following = jax.random.split(physics[1])
            return physics[0] + jax.random.normal(rng, (1,)), following

        def features(self, physics):
            return physics[0]

        def achieved_goal(self, physics):
            return jnp.append(physics[0], 0.0)

    given = play(Shaken(), steady([0.0, 0.0]), 2)
    assert given.valid.all()
    assert len(np.unique(given.features[1:])) == 2 * LENGTH


def test_a_device_steps_no_more_environments_than_the_task_was_made_for():
    class Narrow(Line):
        max_worlds = 3

    def of_two_devices(rng, episodes):
        return rollout(Narrow(), steady(jnp.zeros(episodes // 2)), rng, episodes, axis="devices")

    split = jax.vmap(of_two_devices, in_axes=(None, None), axis_name="devices", axis_size=2)
    assert play(Narrow(), steady(jnp.zeros(3)), 3).valid.all()
    assert jax.eval_shape(lambda rng: split(rng, 6), jax.random.key(0)).valid.shape == (2, 6)
    with pytest.raises(ValueError, match="it must be at most 3"):
        play(Narrow(), steady(jnp.zeros(4)), 4)
    with pytest.raises(ValueError, match="it must be at most 3"):
        jax.eval_shape(lambda rng: split(rng, 8), jax.random.key(0))


def test_means_count_broken_episodes_as_failures_and_in_no_distance():
    outcome = EpisodeMetrics(*np.float32([[1, 0, 1, 0], [1, 0, 0, 0], [1, 1, 1, 0], [1, 2, 3, 0], [4, 5, 6, 0]]))
    valid = np.array([True, True, True, False])
    means = mean_outcome(trajectory(4, outcome=outcome, valid=valid))
    found = [
        float(getattr(means, name)) for name in ("success", "achieved", "success_l1", "distance_l1", "distance_l2")
    ]
    np.testing.assert_allclose(found, [0.5, 0.25, 0.75, 2.0, 5.0], rtol=1e-6)
    blank = jax.tree.map(np.zeros_like, outcome)
    means = mean_outcome(trajectory(4, outcome=blank, valid=np.zeros(4, bool)))
    assert means.success == means.achieved == means.success_l1 == 0.0
    assert np.isinf([means.distance_l1, means.distance_l2]).all()


def test_an_evaluation_tests_the_lift_and_has_no_training_goals():
    seen = []

    class Watched(Breaking):
        def reset(self, rng, training_goals=False):
            seen.append(training_goals)
            return super().reset(rng, training_goals)

    speeds = [0.1, 0.2, 0.3, 0.0]
    measured = jax.jit(lambda rng: evaluate(Watched(), steady(speeds), rng, 4))(jax.random.key(0))
    np.testing.assert_allclose(measured.distance_l1, np.mean([0.75, 1.5, 2.25, 0.0]), rtol=1e-4)
    assert not any(bool(training_goals) for training_goals in seen)

"""Roll-outs and what is drawn from them: hindsight, weights, expert samples and outcomes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binomtest, chi2

from hgail_envs.base import EpisodeMetrics, GoalEnv
from hgail_jax import PPO, Config, Hyperparameters
from hgail_jax.config import BEST, DEMONSTRATIONS, FROZEN, RELABELLED
from hgail_jax.evaluate import evaluate, mean_outcome
from hgail_jax.experts import BestEpisodes, expert_samples, init_expert, keep_best
from hgail_jax.hindsight import FINAL, FUTURE, relabel
from hgail_jax.rollout import Trajectory, rollout
from hgail_jax.samples import (
    Samples,
    _first_above,
    flatten,
    negative_samples,
    policy_samples,
    pursued_samples,
    relabelled_samples,
    step_weight,
)

LENGTH, EPISODES = 6, 40
RNG = np.random.default_rng(0)
draw = jax.jit(Samples.draw, static_argnums=2)


class Line(GoalEnv):
    """A number that actions move; a goal is a number and its kind, and what is achieved is of kind 1 above 2."""

    episode_length, feature_size, goal_size, action_size, success_threshold = LENGTH, 1, 2, 1, 0.5
    goal_kinds = 2
    observation_limit = 50.0

    def reset_physics(self, rng):
        return jax.random.uniform(rng, (1,))

    def step_physics(self, physics, action):
        return physics + action

    def features(self, physics):
        return physics

    def achieved_goal(self, physics):
        return jnp.append(physics, (physics > 2.0).astype(jnp.float32))

    def sample_goal(self, rng, physics):
        return jnp.array([1.0, 0.0])

    def plan_goals(self, rng, physics, training_goals):
        return jnp.where(training_goals, jnp.array([-1.0, 1.0]), self.sample_goal(rng, physics))

    def goal_kind(self, goal):
        return goal[..., 1].astype(jnp.int32)


ENV = Line()


def trajectory(episodes=EPISODES, kind=None, valid=None, **changes):
    """A roll-out in which the achieved goal (100 n + t, kind) says that it is of step t of episode n."""
    time, episode = np.mgrid[: LENGTH + 1, :episodes].astype(np.float32)
    kind = np.zeros_like(time) if kind is None else kind
    wanted = np.stack([-time - 100 * episode - 1, np.broadcast_to(np.arange(episodes) % 4 == 0, time.shape)], axis=-1)
    leaves = {
        "features": 0.5 + time[..., None] + 100 * episode[..., None],
        "achieved": np.stack([time + 100 * episode, kind], axis=-1),
        "desired": wanted.astype(np.float32),
        "action": RNG.normal(size=(LENGTH, episodes, 1)).astype(np.float32),
        "noted": np.zeros((LENGTH, episodes), np.float32),
        "reward": -RNG.integers(0, 2, (LENGTH, episodes)).astype(np.float32),
        "valid": np.ones(episodes, bool) if valid is None else valid,
        "overflow": np.zeros(episodes, bool),
        "outcome": EpisodeMetrics(distance_l1=RNG.uniform(size=episodes).astype(np.float32)),
    } | changes
    return jax.tree.map(jnp.asarray, Trajectory(**leaves))


@jax.jit
def relabelled(trajectory, rng, hyper):
    return relabelled_samples(ENV, hyper, trajectory, rng)


def relabelled_steps(trajectory, seed=0, **changes):
    """Returns goals `[T, N, 2]` and weights `[T, N]` of relabelled samples."""
    hyper = jax.tree.map(jnp.asarray, Hyperparameters(**changes))
    samples = relabelled(trajectory, jax.random.key(seed), hyper)
    np.testing.assert_array_equal(samples.observation[:, :1], trajectory.features[:-1].reshape(-1, 1))
    np.testing.assert_array_equal(samples.action, trajectory.action.reshape(-1, 1))
    episodes = trajectory.valid.shape[0]
    return (np.asarray(leaf).reshape(LENGTH, episodes, -1) for leaf in (samples.observation[:, 1:], samples.weight))


# Samples of a roll-out


def test_policy_samples_are_the_steps_under_the_goals_pursued():
    valid = np.arange(EPISODES) % 3 != 0
    given = trajectory(valid=valid)
    observation = np.concatenate([given.features, given.desired], axis=-1)[:-1]
    weight = np.broadcast_to(valid, (LENGTH, EPISODES)).astype(np.float32)
    ordered, samples = pursued_samples(ENV, given), policy_samples(ENV, given)
    for found, expected in zip(jax.tree.leaves(ordered), (observation, given.action, weight), strict=True):
        np.testing.assert_array_equal(found, expected)
    for found, expected in zip(jax.tree.leaves(samples), (observation, given.action, weight), strict=True):
        np.testing.assert_array_equal(found, expected.reshape(LENGTH * EPISODES, *expected.shape[2:]))
    assert step_weight(given).dtype == jnp.float32
    four = np.arange(120).reshape(2, 3, 4, 5)
    np.testing.assert_array_equal(flatten(four), four.reshape(6, 4, 5))


@pytest.mark.parametrize("share", [0.0, 0.7, 1.0])
def test_negatives_have_the_goal_of_another_episode_at_that_step(share):
    given = trajectory(valid=np.arange(EPISODES) % 3 != 0)
    samples = negative_samples(ENV, Hyperparameters(shuffled_goals=share), given, jax.random.key(0))
    plain = policy_samples(ENV, given)
    np.testing.assert_array_equal(samples.observation[:, 0], plain.observation[:, 0])
    np.testing.assert_array_equal(samples.action, plain.action)
    np.testing.assert_array_equal(samples.weight, plain.weight)
    time, own = np.mgrid[:LENGTH, :EPISODES]
    code = -np.asarray(samples.observation[:, 1]).reshape(LENGTH, EPISODES) - 1  # 100 n + t, see `trajectory`
    np.testing.assert_array_equal(code % 100, time)
    another = code // 100 != own
    if share in (0.0, 1.0):
        assert (another == bool(share)).all()
    else:
        assert binomtest(int(another.sum()), another.size, share).pvalue > 1e-5


def test_relabelled_goals_are_jittered_within_the_tolerance_and_nothing_else_is():
    given, rng = trajectory(), jax.random.key(0)
    samples = jax.jit(lambda jitter: relabelled_samples(ENV, Hyperparameters(), given, rng, jitter=jitter))
    exact, jittered = samples(0.0), samples(0.5)
    moved = np.asarray(jittered.observation - exact.observation)[:, 1:]
    half = 0.5 * np.asarray(ENV.goal_tolerance(exact.observation[:, 1:]))
    assert (np.abs(moved) <= half + 1e-4).all() and np.abs(moved).max() > 0.8 * half.max()
    assert len(np.unique(moved[:, 0])) > 0.9 * len(moved)  # each its own
    np.testing.assert_array_equal(jittered.weight, exact.weight)
    np.testing.assert_array_equal(jittered.observation[:, 0], exact.observation[:, 0])


def test_without_relabelling_goals_stay_as_pursued():
    given = trajectory(kind=np.ones((LENGTH + 1, EPISODES), np.float32))
    for strategy in (FUTURE, FINAL):
        goal, weight = relabelled_steps(given, p_ht=0.0, strategy=strategy)
        np.testing.assert_array_equal(goal, given.desired[:-1])
        np.testing.assert_allclose(weight, 1.0, rtol=1e-4)


@pytest.mark.parametrize("include_current", [False, True])
def test_future_goals_are_achieved_later_in_the_same_episode(include_current):
    goal, _ = relabelled_steps(trajectory(400), include_current=include_current)
    episode, time = np.divmod(goal[..., 0], 100)
    np.testing.assert_array_equal(episode, np.broadcast_to(np.arange(400), episode.shape))
    for step in range(LENGTH):
        first = step if include_current else step + 1
        counts = np.bincount(time[step].astype(int), minlength=LENGTH + 1)
        assert counts[:first].sum() == 0
        expected = 400 / (LENGTH + 1 - first)
        assert (
            ((counts[first:] - expected) ** 2 / expected).sum() <= max(chi2.isf(1e-4, LENGTH - first), 1e-9)
            if first < LENGTH
            else True
        )


def test_final_goals_are_achieved_last():
    for include_current in (False, True):
        goal, _ = relabelled_steps(trajectory(), strategy=FINAL, include_current=include_current)
        np.testing.assert_array_equal(
            goal[..., 0], np.broadcast_to(100.0 * np.arange(EPISODES) + LENGTH, goal.shape[:2])
        )


def test_the_share_of_relabelled_steps_is_as_asked_and_each_decides_for_itself():
    given = trajectory(400)
    goal, _ = relabelled_steps(given, p_ht=0.3)
    chosen = goal[..., 0] >= 0
    np.testing.assert_array_equal(goal[~chosen], np.asarray(given.desired[:-1])[~chosen])
    assert abs(chosen.mean() - 0.3) < 0.04
    assert np.abs(np.corrcoef(chosen) - np.eye(LENGTH)).max() < 0.25
    again, _ = relabelled_steps(given, seed=1, p_ht=0.3)
    assert ((again[..., 0] >= 0) != chosen).any()


def test_which_step_is_chosen_says_nothing_of_where_its_goal_comes_from():
    """Were one key used for both, a step chosen with a small probability would have early sources only."""
    found = jax.jit(jax.vmap(lambda rng: relabel(rng, jnp.zeros((9, 1)), jnp.zeros(1), 0.2)))(
        jax.random.split(jax.random.key(5), 4000)
    )
    chosen, source = np.asarray(found.chosen), np.asarray(found.source)
    assert (source > np.arange(8)).all()
    for step in range(7):
        assert abs(source[chosen[:, step], step].mean() - (step + 9) / 2) < 0.45


def test_kinds_count_only_where_their_shares_are_given_too():
    achieved, desired, kind = jnp.arange(10.0)[:, None], jnp.zeros(1), jnp.arange(10) % 2
    given = jax.jit(functools.partial(relabel, jax.random.key(0), achieved, desired, 0.5))
    assert_same(given(kind=kind), given())
    assert_same(given(kind_share=jnp.ones(2)), given())


def test_shapes_that_do_not_fit_are_refused():
    one = jax.jit(relabel)(jax.random.key(0), jnp.array([[1.0, 2.0], [3.0, 4.0]]), jnp.zeros(2), 1.0)
    np.testing.assert_array_equal(one.goal, [[3.0, 4.0]])
    whole = jax.jit(relabel)(jax.random.key(0), jnp.ones((4, 2)), jnp.zeros((3, 2)), 0.0)
    np.testing.assert_array_equal(whole.goal, np.zeros((3, 2)))
    for achieved, desired in (
        ((1, 2), (2,)),
        ((1, 2), (0, 2)),
        ((4, 2), (4, 2)),
        ((4, 2), (3,)),
        ((4,), ()),
        ((4, 2, 2), (2, 2)),
    ):
        with pytest.raises(ValueError, match="achieved and desired"):
            relabel(jax.random.key(0), jnp.ones(achieved), jnp.zeros(desired), 1.0)
    with pytest.raises(ValueError, match="p_ht"):
        relabel(jax.random.key(0), jnp.ones((4, 2)), jnp.zeros(2), 1.5)


def test_kinds_have_among_samples_drawn_the_share_they_have_among_goals_pursued():
    kind = (RNG.uniform(size=(LENGTH + 1, 400)) < 0.1).astype(np.float32)
    valid = np.arange(400) % 5 != 0
    given = trajectory(400, kind=kind, valid=valid)
    wanted = np.asarray(given.desired[:-1, valid, 1]).mean()
    for changes in ({}, {"p_ht": 0.5}, {"strategy": FINAL}):
        goal, weight = relabelled_steps(given, **changes)
        assert (weight[:, ~valid] == 0).all()
        assert (weight[:, valid] > 0).all()
        share = (weight[..., 0] * goal[..., 1]).sum() / weight.sum()
        assert share == pytest.approx(wanted, rel=1e-3)
        assert abs(goal[:, valid, 1].mean() - wanted) > 0.01
        for each in (0.0, 1.0):  # within a kind all samples count alike
            of_kind = weight[:, valid][goal[:, valid, 1] == each].ravel()
            np.testing.assert_allclose(of_kind, of_kind[0], rtol=1e-5)
        np.testing.assert_allclose(weight.sum(), LENGTH * valid.sum(), rtol=1e-2)


def test_kinds_that_are_not_pursued_or_not_achieved_do_no_harm():
    for kind in (0.0, 1.0):
        given = trajectory(kind=np.full((LENGTH + 1, EPISODES), kind, np.float32))
        goal, weight = relabelled_steps(given)
        assert (goal[..., 1] == kind).all()
        assert np.isfinite(weight).all()
        assert (weight > 0).all()
    none = given.replace(desired=given.desired.at[..., 1].set(0.0))
    _, weight = relabelled_steps(none)
    assert np.isfinite(weight).all()
    assert (weight > 0).all()
    rare = given.replace(desired=given.desired.at[..., 1].set(0.0), achieved=given.achieved.at[:, 0, 1].set(0.0))
    goal, weight = relabelled_steps(rare)
    kind = goal[..., 1]
    by_hand = np.where(kind == 1, 1e-6 / (kind.mean() + 1e-6), 1.0 / (1.0 - kind.mean()))  # of 0 a millionth is left
    np.testing.assert_allclose(weight[..., 0], by_hand, rtol=1e-3)
    broken = given.replace(valid=jnp.zeros(EPISODES, bool))
    _, weight = relabelled_steps(broken)
    np.testing.assert_array_equal(weight, 0.0)


def test_a_rare_kind_ahead_is_drawn_as_often_as_it_is_pursued():
    kind = np.zeros((LENGTH + 1, 1000), np.float32)
    kind[LENGTH] = 1.0
    given = trajectory(1000, kind=kind)  # a quarter of the goals pursued are of kind 1
    goal, _ = relabelled_steps(given)
    share = goal[..., 1].mean(axis=1)
    np.testing.assert_allclose(share[:-1], 0.25, atol=0.06)
    assert share[-1] == 1.0


# Expert samples


def best_episodes(count):
    config = Config(PPO(), expert_source=BEST, best_episodes=count, num_envs=EPISODES)
    return init_expert(ENV, config, None)


def episode_numbers(best):
    return (np.asarray(best.samples.observation)[0, :, 0] // 100).astype(int)


@pytest.mark.parametrize("ties", [False, True])
def test_the_best_episodes_are_those_of_a_sorted_list(ties):
    hyper = Hyperparameters(ties_by_distance=jnp.array(ties))
    valid = np.arange(EPISODES) % 7 != 0
    keep = jax.jit(lambda best, given: keep_best(ENV, hyper, best, given))
    best, listed = best_episodes(10), []
    for shift in (0, 1, 2):
        given = trajectory(valid=valid)
        given = given.replace(features=given.features + 100 * EPISODES * shift)
        best = keep(best, given)
        returns, distance = np.asarray(given.reward).sum(axis=0), np.asarray(given.outcome.distance_l1)
        listed += [(-returns[n], ties * distance[n], n + EPISODES * shift) for n in range(EPISODES) if valid[n]]
        expected = sorted(listed)[:10]
        np.testing.assert_array_equal(episode_numbers(best), [number for *_, number in expected])
        np.testing.assert_array_equal(best.returns, [-minus for minus, *_ in expected])
        if ties:
            np.testing.assert_allclose(best.distance, [near for _, near, _ in expected])
        np.testing.assert_array_equal(best.samples.weight, np.ones((LENGTH, 10)))
        for place, (*_, number) in enumerate(expected):
            if number >= EPISODES * shift:
                np.testing.assert_array_equal(best.samples.action[:, place], given.action[:, number % EPISODES])


def test_places_that_no_valid_episode_fills_have_no_weight():
    valid = np.arange(EPISODES) < 3
    best = keep_best(ENV, Hyperparameters(), best_episodes(5), trajectory(valid=valid))
    np.testing.assert_array_equal(best.samples.weight, np.broadcast_to([1, 1, 1, 0, 0], (LENGTH, 5)))
    assert (np.asarray(best.returns)[3:] == np.finfo(np.float32).min).all()
    empty = best_episodes(5)
    assert isinstance(empty, BestEpisodes)
    assert empty.samples.observation.shape == (LENGTH, 5, 3)
    assert empty.samples.action.shape == (LENGTH, 5, 1)
    assert all((leaf == 0).all() for leaf in jax.tree.leaves(empty.samples))
    np.testing.assert_array_equal(empty.returns, np.full(5, np.finfo(np.float32).min))
    np.testing.assert_array_equal(empty.distance, np.zeros(5))


def learn_from(source, expert, given, seed=0):
    config, key = Config(PPO(), expert_source=source, best_episodes=5, num_envs=EPISODES), jax.random.key(seed)
    return expert_samples(ENV, config, jax.tree.map(jnp.asarray, Hyperparameters()), expert, given, key)


def assert_same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_each_source_gives_its_expert_samples():
    first, second = trajectory(valid=np.arange(EPISODES) > 1), trajectory(valid=np.arange(EPISODES) > 4)
    fresh = relabelled(first, jax.random.key(0), jax.tree.map(jnp.asarray, Hyperparameters()))
    kept, samples = learn_from(RELABELLED, None, first)
    assert kept is None
    assert_same(samples, fresh)
    frozen = init_expert(ENV, Config(PPO(), expert_source=FROZEN, num_envs=EPISODES), None)
    assert_same(frozen, jax.tree.map(jnp.zeros_like, fresh))
    for given, seed in ((first, 0), (second, 1)):
        frozen, samples = learn_from(FROZEN, frozen, given, seed)
        assert_same((frozen, samples), (fresh, fresh))
    mine = Samples(jnp.ones((7, 3)), jnp.ones((7, 1)), jnp.arange(7.0))
    config = Config(PPO(), expert_source=DEMONSTRATIONS)
    assert_same(init_expert(ENV, config, mine), mine)
    assert_same(learn_from(DEMONSTRATIONS, mine, first), (mine, mine))
    best, samples = learn_from(BEST, best_episodes(5), second)
    assert_same(best, keep_best(ENV, Hyperparameters(), best_episodes(5), second))
    assert_same(samples, flatten(best.samples))
    assert init_expert(ENV, Config(PPO()), None) is None


def test_demonstrations_are_given_where_they_are_asked_for_and_nowhere_else():
    mine = Samples(jnp.ones((7, 3)), jnp.ones((7, 1)), jnp.ones(7))
    with pytest.raises(ValueError, match="demonstrations are given"):
        init_expert(ENV, Config(PPO()), mine)
    with pytest.raises(ValueError, match="none are given"):
        init_expert(ENV, Config(PPO(), expert_source=DEMONSTRATIONS), None)
    for bad in (
        mine.replace(weight=jnp.ones(6)),
        mine.replace(action=jnp.ones((7, 2))),
        mine.replace(weight=1.0 * jnp.ones(())),
    ):
        with pytest.raises(ValueError, match="demonstrations have"):
            init_expert(ENV, Config(PPO(), expert_source=DEMONSTRATIONS), bad)


# Roll-outs and their outcome


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


# Drawing


@pytest.mark.parametrize("samples", [1, 2, 3, 7, 12, 16, 17, 30])
@pytest.mark.parametrize("kind", ["even", "random", "zero at the ends", "one"])
def test_draws_follow_the_weights(samples, kind):
    weight = {
        "even": np.full(samples, 3.0),
        "random": RNG.uniform(0.1, 1.0, samples) * RNG.integers(1, 9, samples),
        "zero at the ends": np.pad(RNG.integers(0, 3, samples) + np.eye(samples)[samples // 2], (5, 9)),
        "one": np.eye(samples)[-1] * 0.2,
    }[kind]
    weight = np.asarray(weight, np.float32)
    of_weight = Samples(jnp.zeros((len(weight), 1)), jnp.zeros((len(weight), 1)), jnp.asarray(weight))
    drawn = np.asarray(draw(of_weight, jax.random.key(samples), (100, 200)))
    assert drawn.shape == (100, 200)
    counts = np.bincount(drawn.ravel(), minlength=len(weight))
    assert len(counts) == len(weight)
    assert (counts[weight == 0] == 0).all()
    expected, found = (array[weight > 0] for array in (20000 * weight / weight.sum(), counts))
    assert (
        ((found - expected) ** 2 / expected).sum() <= chi2.isf(1e-4, len(expected) - 1) if len(expected) > 1 else True
    )


def test_of_more_samples_than_a_single_number_counts_every_one_can_be_drawn():
    count = 2**24 + 2**22 + 3
    samples = Samples(jnp.zeros((1, 1)), jnp.zeros((1, 1)), jnp.ones(count))
    drawn = np.asarray(draw(samples, jax.random.key(0), (256_000,)))
    assert drawn.min() >= 0
    assert drawn.max() < count
    for region, regions in ((drawn * 64 // count, 64), (drawn % 16, 16), (drawn % 4489, 4489)):
        counts = np.bincount(region, minlength=regions)
        assert ((counts - counts.mean()) ** 2 / counts.mean()).sum() < chi2.isf(1e-4, regions - 1)


def test_what_has_no_weight_is_not_drawn_even_by_the_least_number():
    cumulative = jnp.array([[0.0, 0.0, 1.0, 1.0, 3.0], [2.0, 2.0, 2.0, 5.0, 9.0]])
    block, target = jnp.array([0, 0, 0, 0, 1, 1, 1]), jnp.array([0.0, 0.9, 1.0, 2.9, 0.0, 2.0, 5.0])
    np.testing.assert_array_equal(_first_above(cumulative, block, target), [2, 2, 4, 4, 0, 3, 4])


def test_solved_samples_count_less_and_kinds_keep_their_shares():
    class Solved(Line):
        def already_solved(self, features, goal):
            return goal[..., 0] - features[..., 0] < 1.0  # the goal is what the step itself achieves

    kind = np.broadcast_to(np.arange(LENGTH + 1)[:, None] % 2, (LENGTH + 1, 400)).astype(np.float32)
    given, key = trajectory(400, kind=kind), jax.random.key(2)

    def relabel(weight):
        hyper = jax.tree.map(jnp.asarray, Hyperparameters(solved_weight=weight))
        return jax.jit(lambda: relabelled_samples(Solved(), hyper, given, key))()

    plain, weighted = relabel(1.0), relabel(0.25)
    np.testing.assert_array_equal(plain.observation, weighted.observation)
    features, goal, of_kind = np.asarray(plain.observation).T
    solved = goal - features < 1.0
    for each, wanted in ((0, 0.75), (1, 0.25)):  # the shares among the desired goals
        chosen = of_kind == each
        for samples in (plain, weighted):
            share = samples.weight[chosen].sum() / samples.weight.sum()
            np.testing.assert_allclose(share, wanted, rtol=1e-3)
        assert solved[chosen].any()
        assert not solved[chosen].all()
        light, heavy = (np.unique(np.asarray(weighted.weight)[chosen & mask]) for mask in (solved, ~solved))
        np.testing.assert_allclose(light / heavy[0], 0.25, rtol=1e-4)
        assert np.ptp(np.asarray(plain.weight)[chosen]) == 0.0

"""Samples of a roll-out: hindsight, weights, and how they are drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binomtest, chi2

from hgail_jax import Hyperparameters
from hgail_jax.hindsight import FINAL, FUTURE
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
from tests.hgail_jax.line import ENV, EPISODES, LENGTH, RNG, Line, trajectory

draw = jax.jit(Samples.draw, static_argnums=2)


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
    assert (np.abs(moved) <= half + 1e-4).all() and min(moved.max(), -moved.min()) > 0.8 * half.max()
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

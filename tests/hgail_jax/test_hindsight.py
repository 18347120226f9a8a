"""Algorithm 1 against its own words: the law of every step's source, worked out by hand."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binomtest, chisquare

from hgail_jax.config import STRATEGIES
from hgail_jax.hindsight import FINAL, FUTURE, count_kinds, draw_source, relabel

LENGTH, DRAWS = 7, 20_000
# A goal says where it is from: achieved in state l is (l, 100), desired in step j is (j, -100).
ACHIEVED = jnp.stack([jnp.arange(0.0, LENGTH + 1), jnp.full(LENGTH + 1, 100.0)], axis=1)
DESIRED = jnp.stack([jnp.arange(0.0, LENGTH), jnp.full(LENGTH, -100.0)], axis=1)
KINDS = {"one": [0] * 8, "two": [1, 0, 0, 1, 0, 0, 1, 0], "three": [0, 2, 1, 1, 2, 0, 1, 0]}
SHARES = {"one": [1.0], "two": [0.3, 0.7], "three": [0.5, 0.2, 0.3]}
UNLIKELY = 1e-5  # a p-value; keys are fixed, so that a test does not fail by chance now and then


@functools.partial(jax.jit, static_argnames="draws")
def draw(p_ht, strategy=FUTURE, include_current=False, kind=None, kind_share=None, draws=DRAWS):
    rngs = jax.random.split(jax.random.key(0), draws)
    return jax.vmap(lambda rng: relabel(rng, ACHIEVED, DESIRED, p_ht, strategy, include_current, kind, kind_share))(
        rngs
    )


draw_one, relabelled = jax.jit(draw_source), jax.jit(relabel)


def law(step, strategy, include_current, kind, share):
    """Returns the probability of each state to be the source of a step's goal, `[T + 1]`."""
    probability = np.zeros(LENGTH + 1)
    if strategy == FINAL:
        probability[LENGTH] = 1.0
        return probability
    ahead = [state for state in range(LENGTH + 1) if state > step or (include_current and state == step)]
    present = {kind[state] for state in ahead}
    for state in ahead:
        of_its_kind = [other for other in ahead if kind[other] == kind[state]]
        probability[state] = share[kind[state]] / sum(share[one] for one in present) / len(of_its_kind)
    return probability


@pytest.mark.parametrize("strategy", STRATEGIES.values(), ids=STRATEGIES)
@pytest.mark.parametrize("include_current", [False, True])
@pytest.mark.parametrize("kinds", KINDS)
def test_the_source_of_every_step_follows_the_law(strategy, include_current, kinds):
    kind, share = KINDS[kinds], SHARES[kinds]
    given = {} if kinds == "one" else {"kind": jnp.array(kind), "kind_share": jnp.array(share)}
    source = np.asarray(draw(1.0, strategy, include_current, **given).source)
    for step in range(LENGTH):
        expected = DRAWS * law(step, strategy, include_current, kind, share)
        counts = np.bincount(source[:, step], minlength=LENGTH + 1)
        possible = expected > 0
        assert counts[~possible].sum() == 0
        if possible.sum() > 1:
            assert chisquare(counts[possible], expected[possible]).pvalue > UNLIKELY


@pytest.mark.parametrize("strategy", STRATEGIES.values(), ids=STRATEGIES)
@pytest.mark.parametrize("include_current", [False, True])
@pytest.mark.parametrize("p_ht", [0.0, 0.3, 1.0])
def test_a_goal_is_the_one_achieved_at_its_source_where_chosen_and_else_the_desired_one(
    strategy, include_current, p_ht
):
    hindsight = jax.tree.map(np.asarray, draw(p_ht, strategy, include_current, draws=500))
    for goals, chosen, source in zip(*hindsight, strict=True):
        for step in range(LENGTH):
            expected = [source[step], 100] if chosen[step] else [step, -100]
            np.testing.assert_array_equal(goals[step], expected)


@pytest.mark.parametrize("p_ht", [0.0, 0.1, 0.8, 1.0])
def test_each_step_is_chosen_with_the_probability_asked_for_whatever_the_others(p_ht):
    chosen = np.asarray(draw(p_ht).chosen)
    for step in range(LENGTH):
        assert binomtest(int(chosen[:, step].sum()), DRAWS, p_ht).pvalue > UNLIKELY
    for step in range(LENGTH - 1):
        both = int((chosen[:, step] & chosen[:, step + 1]).sum())
        assert binomtest(both, DRAWS, p_ht**2).pvalue > UNLIKELY


def test_sources_of_two_steps_are_drawn_apart():
    """Two early steps have six states in common, each with the other's probability: one in six draws they meet."""
    source = np.asarray(draw(1.0).source)
    meet = int((source[:, 0] == source[:, 1]).sum())
    assert binomtest(meet, DRAWS, 6 * (1 / 7) * (1 / 6)).pvalue > UNLIKELY


def test_a_goal_pursued_all_along_may_be_given_once():
    rng, goal = jax.random.key(3), jnp.array([7.0, 8.0])
    once = relabelled(rng, ACHIEVED, goal, 0.5)
    for_each_step = relabelled(rng, ACHIEVED, jnp.tile(goal, (LENGTH, 1)), 0.5)
    jax.tree.map(np.testing.assert_array_equal, once, for_each_step)
    assert 0 < once.chosen.sum() < LENGTH


def test_hyperparameters_may_be_traced_and_swept():
    p_ht, strategies, current = (
        jnp.array([0.0, 1.0, 1.0]),
        jnp.array([FUTURE, FUTURE, FINAL]),
        jnp.array([0, 1, 0], bool),
    )
    sweep = jax.vmap(lambda *one: relabelled(jax.random.key(0), ACHIEVED, DESIRED, *one))
    swept = sweep(p_ht, strategies, current)
    for index in range(3):
        alone = relabelled(jax.random.key(0), ACHIEVED, DESIRED, p_ht[index], strategies[index], current[index])
        jax.tree.map(
            lambda ours, all_of_them, i=index: np.testing.assert_array_equal(ours, all_of_them[i]), alone, swept
        )
    assert not swept.chosen[0].any()
    np.testing.assert_array_equal(swept.source[2], LENGTH)


def test_states_before_each_one_are_counted_by_kind():
    kind = np.random.default_rng(0).integers(0, 3, (4, LENGTH + 1))
    expected = [[[(row[:state] == one).sum() for one in range(3)] for state in range(LENGTH + 2)] for row in kind]
    np.testing.assert_array_equal(count_kinds(jnp.asarray(kind), 3), expected)


@pytest.mark.parametrize("kinds", KINDS)
def test_single_steps_are_drawn_by_the_law_of_whole_episodes(kinds):
    share = SHARES[kinds]
    counts = count_kinds(jnp.array([KINDS["two"], KINDS[kinds]]) % len(share), len(share))
    for step in range(LENGTH):
        same = jnp.ones(DRAWS, jnp.int32)
        arguments = (counts, same, same * (step + 1), same * LENGTH, jnp.array(share))
        expected = DRAWS * law(step, FUTURE, False, KINDS[kinds], share)
        found = np.bincount(draw_one(jax.random.key(step), *arguments), minlength=LENGTH + 1)
        possible = expected > 0
        assert found[~possible].sum() == 0
        if possible.sum() > 1:
            assert chisquare(found[possible], expected[possible]).pvalue > UNLIKELY
        assert (draw_one(jax.random.key(step), *arguments, FINAL) == LENGTH).all()


@pytest.mark.parametrize("kinds", KINDS)
def test_a_number_that_rounding_brings_to_the_end_draws_the_last_state_of_the_last_kind(monkeypatch, kinds):
    share = SHARES[kinds]
    kind = np.array(KINDS[kinds]) % len(share)
    monkeypatch.setattr(jax.random, "uniform", lambda rng, shape: jnp.ones(shape))
    draw_last = jax.jit(lambda *given: draw_source(*given))  # compiled with the ones
    for first in range(1, LENGTH + 1):
        drawn = draw_last(
            jax.random.key(0),
            count_kinds(jnp.array([kind]), len(share)),
            jnp.zeros(1, jnp.int32),
            jnp.array([first]),
            jnp.array([LENGTH]),
            jnp.array(share),
            FUTURE,
        )
        assert drawn[0] == first + np.flatnonzero(kind[first:] == kind[first:].max())[-1]


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
    for more in ({"kind": kind}, {"kind_share": jnp.ones(2)}):
        jax.tree.map(np.testing.assert_array_equal, given(**more), given())


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

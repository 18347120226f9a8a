import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hgail_jax.config import STRATEGIES
from hgail_jax.hindsight import FINAL, FUTURE, relabel

LENGTH, TRAJECTORIES = 12, 400
# The achieved goal of state l of trajectory n is (n, l), so that every goal says where it came from.
ACHIEVED = np.stack(
    np.broadcast_arrays(np.arange(TRAJECTORIES)[:, None], np.arange(LENGTH + 1)[None, :]), axis=-1
).astype(np.float32)
DESIRED = np.full((TRAJECTORIES, 2), -1.0, np.float32)


def relabel_all(p_ht, strategy=FUTURE, include_current=False):
    rngs = jax.random.split(jax.random.key(0), TRAJECTORIES)
    relabel_batch = jax.jit(jax.vmap(relabel, in_axes=(0, 0, 0, None, None, None)))
    return jax.tree.map(np.asarray, relabel_batch(rngs, ACHIEVED, DESIRED, p_ht, strategy, include_current))


def by_loop(hindsight):
    """Algorithm 1 as a plain double loop, given which steps are chosen and which later state each one takes."""
    goals = np.empty((TRAJECTORIES, LENGTH, 2), np.float32)
    for n in range(TRAJECTORIES):
        for j in range(LENGTH):
            goals[n, j] = ACHIEVED[n, hindsight.source[n, j]] if hindsight.chosen[n, j] else DESIRED[n]
    return goals


@pytest.mark.parametrize("p_ht", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("strategy", STRATEGIES.values(), ids=STRATEGIES)
@pytest.mark.parametrize("include_current", [False, True])
def test_agrees_with_a_double_loop(p_ht, strategy, include_current):
    hindsight = relabel_all(p_ht, strategy, include_current)
    np.testing.assert_array_equal(hindsight.goal, by_loop(hindsight))


@pytest.mark.parametrize("include_current", [False, True])
def test_a_goal_is_achieved_later_in_the_same_trajectory(include_current):
    goal = relabel_all(1.0, FUTURE, include_current).goal
    step = np.arange(LENGTH)[None, :]
    np.testing.assert_array_equal(goal[..., 0], ACHIEVED[:, :LENGTH, 0])
    first = step if include_current else step + 1
    assert (goal[..., 1] >= first).all()
    assert (goal[..., 1] <= LENGTH).all()


def test_final_takes_the_last_state():
    assert (relabel_all(1.0, FINAL).goal[..., 1] == LENGTH).all()


def test_steps_that_are_not_chosen_keep_their_goal():
    hindsight = relabel_all(0.5)
    np.testing.assert_array_equal(hindsight.goal[~hindsight.chosen], -1.0)
    assert abs(hindsight.chosen.mean() - 0.5) < 0.03
    np.testing.assert_array_equal(relabel_all(0.0).goal, np.broadcast_to(DESIRED[:, None], (TRAJECTORIES, LENGTH, 2)))
    assert relabel_all(1.0).chosen.all()


def test_future_steps_are_drawn_uniformly():
    source = relabel_all(1.0).source[:, 4]
    counts = np.bincount(source, minlength=LENGTH + 1)
    expected = TRAJECTORIES / (LENGTH - 4)
    assert counts[:5].sum() == 0
    chi_squared = ((counts[5:] - expected) ** 2 / expected).sum()
    assert chi_squared < 24.3  # 0.1 % point of 7 degrees of freedom


def test_hyperparameters_may_be_traced_and_swept():
    p_ht = jnp.array([0.0, 1.0])
    chosen = jax.vmap(lambda p: relabel(jax.random.key(0), ACHIEVED[0], DESIRED[0], p).chosen)(p_ht)
    assert not chosen[0].any()
    assert chosen[1].all()


def test_kinds_ahead_are_drawn_by_their_shares():
    """Against the probabilities by hand: a kind by its share among those ahead, then one of its steps."""
    kind = np.array([0, 0, 0, 0, 1, 0, 0, 0, 1, 1, 0, 0, 0])
    achieved = jnp.asarray(ACHIEVED[0])
    share = jnp.array([0.3, 0.7])
    rngs = jax.random.split(jax.random.key(1), 4000)
    draw = jax.jit(
        jax.vmap(lambda rng: relabel(rng, achieved, DESIRED[0], 1.0, kind=jnp.asarray(kind), kind_share=share).source)
    )
    source = np.asarray(draw(rngs))
    for step in (0, 4, 7, 10):
        ahead = np.arange(step + 1, LENGTH + 1)
        present = [k for k in (0, 1) if (kind[ahead] == k).any()]
        total = sum(float(share[k]) for k in present)
        counts = np.bincount(source[:, step], minlength=LENGTH + 1) / len(source)
        assert counts[: step + 1].sum() == 0
        for state in ahead:
            expected = float(share[kind[state]]) / total / (kind[ahead] == kind[state]).sum()
            assert counts[state] == pytest.approx(expected, abs=0.03)

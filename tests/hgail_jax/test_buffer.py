"""The replay buffer against loops: what is kept, and what is drawn how often."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binomtest, chisquare

from hgail_envs.base import EpisodeMetrics, GoalEnv
from hgail_jax import Hyperparameters, Trajectory
from hgail_jax.buffer import (
    ReplayHyperparameters,
    add_episodes,
    draw,
    draw_achieved,
    draw_future,
    draw_negatives,
    draw_positives,
    init_buffer,
)
from hgail_jax.discriminator import discriminator_loss
from hgail_jax.hindsight import FINAL, FUTURE
from hgail_jax.samples import shuffle_goals

LENGTH, HELD, DRAWS = 5, 4, 40_000
UNLIKELY = 1e-5  # a p-value; keys are fixed, so that a test does not fail by chance now and then
# kinds of the achieved goals of each episode's states
KINDS = np.array([[0, 1, 0, 1, 1, 0], [1, 1, 1, 0, 0, 0], [0, 0, 0, 0, 0, 1], [1, 0, 1, 0, 1, 0]])


class Line(GoalEnv):
    """Goals are numbers and their kinds. A state is at a goal that is at most 1 from what it has achieved."""

    episode_length, feature_size, goal_size, action_size, success_threshold = LENGTH, 1, 2, 2, 1.0
    goal_kinds = 2

    def reset_physics(self, rng):
        return jnp.zeros(1)

    def step_physics(self, physics, action):
        return physics

    def features(self, physics):
        return physics

    def achieved_goal(self, physics):
        return jnp.append(physics, 0.0)

    def sample_goal(self, rng, physics):
        return jnp.zeros(2)

    def goal_kind(self, goal):
        return goal[..., 1].astype(jnp.int32)

    def goal_test(self, features, achieved, goal):
        """Of the features too, so that those of another state are noticed."""
        return (jnp.abs(achieved - goal)[..., 0] <= 1.0) & (features[..., 0] > 0.0)

    def already_solved(self, features, goal):
        """Solved where the goal is achieved two steps later."""
        return jnp.abs(goal[..., 0] - features[..., 0] - 2.0) < 0.25


ENV = Line()
add = jax.jit(add_episodes)


def trajectory(numbers, valid=None):
    """Episodes whose achieved goal `(100 n + t, kind)` is of state `t` of episode `n`, their features .1 more."""
    time, episode = np.meshgrid(np.arange(LENGTH + 1.0), np.array(numbers, float), indexing="ij")
    kind = KINDS[np.array(numbers) % HELD].T
    achieved = np.stack([time + 100 * episode, kind], axis=-1)
    wanted = np.stack([time + 100 * episode + 0.5, episode % 4 == 1], axis=-1)  # one of four episodes pursues kind 1
    action = np.stack([time + 10 * episode, -time], axis=-1)[:-1] / 20 - 0.3  # some are beyond [-1, 1]
    zeros = np.zeros((LENGTH, len(numbers)))
    leaves = Trajectory(
        features=achieved[..., :1] + 0.1,
        achieved=achieved,
        desired=wanted,
        action=action,
        noted=zeros,
        reward=zeros,
        valid=np.ones(len(numbers), bool) if valid is None else np.array(valid),
        overflow=np.zeros(len(numbers), bool),
        outcome=EpisodeMetrics(),
    )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, bool if np.asarray(leaf).dtype == bool else jnp.float32), leaves)


@functools.partial(jax.jit, static_argnums=7)
def draw_by(buffer, rng, p_ht, strategy, most_ahead, solved_weight, current, count):
    hyper = Hyperparameters(strategy=strategy, solved_weight=solved_weight, include_current=current)
    return draw(ENV, hyper, buffer, rng, count, p_ht, most_ahead)


def drawn(buffer, rng, p_ht, strategy=FUTURE, most_ahead=2**30, solved_weight=1.0, current=False, count=DRAWS):
    """Draws by one program, whichever of the arguments are given."""
    return draw_by(buffer, rng, p_ht, strategy, most_ahead, solved_weight, current, count)


goals_of = jax.jit(draw_achieved, static_argnums=(0, 3))


def full(valid=None):
    return add(init_buffer(ENV, HELD), trajectory(range(HELD), valid))


def origin(transitions):
    """Returns episodes, steps, whether a goal was replaced, and the states that goals are from, each `[B]`."""
    feature, goal = np.asarray(transitions.observation[:, 0]), np.asarray(transitions.observation[:, 1])
    place, chosen = np.rint(feature - 0.1).astype(int), goal % 1 < 0.25
    np.testing.assert_allclose(place + 0.1, feature, atol=1e-4)
    replaced = goal.astype(int)
    assert (replaced[chosen] // 100 == place[chosen] // 100).all(), "a goal is of its own episode"
    return place // 100, place % 100, chosen, np.where(chosen, replaced % 100, -1)


# Adding


def held_in(buffer):
    """Returns the number of the episode in each place, -1 where there is none."""
    for name, size in (("features", 1), ("achieved", 2), ("desired", 2)):
        assert getattr(buffer, name).shape == (HELD, LENGTH + 1, size)
    return [
        int(first) // 100 if valid else -1 for first, valid in zip(buffer.achieved[:, 1, 0], buffer.valid, strict=True)
    ]


def test_episodes_fill_the_buffer_and_then_replace_the_oldest():
    buffer, added = init_buffer(ENV, HELD), 0
    assert held_in(buffer) == [-1] * HELD
    expected = [-1] * HELD
    for count in (3, 2, 1, 4, 3):
        numbers = range(added, added + count)
        buffer = add(buffer, trajectory(numbers))
        for number in numbers:
            expected[number % HELD] = number
        added += count
        assert held_in(buffer) == expected
        assert buffer.added == added


def test_an_episode_is_kept_as_it_was_with_its_actions_clipped():
    given = trajectory(range(HELD), [True, False, True, True])
    buffer = add(init_buffer(ENV, HELD), given)
    for name in ("features", "achieved", "desired"):
        np.testing.assert_array_equal(getattr(buffer, name), np.asarray(getattr(given, name)).swapaxes(0, 1))
    action = np.asarray(given.action).swapaxes(0, 1)
    assert (np.abs(action) > 1).any()
    np.testing.assert_array_equal(buffer.action, np.clip(action, -1, 1))
    np.testing.assert_array_equal(buffer.valid, given.valid)


def test_a_roll_out_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="a roll-out of 5 episodes does not fit into a buffer of 4"):
        add_episodes(init_buffer(ENV, HELD), trajectory(range(5)))


# Drawing


def law(p_ht, strategy, most_ahead, valid=(True,) * HELD, current=False):
    """Returns the probability of each episode, step and source; source -1 is the goal that was pursued."""
    kind_one = np.mean([number % 4 == 1 for number in range(HELD) if valid[number]])
    share = {0: 1 - kind_one, 1: kind_one}
    probability = {}
    for episode in range(HELD):
        for step in range(LENGTH):
            one = 1 / HELD / LENGTH
            probability[episode, step, -1] = one * (1 - p_ht)
            first = step if current else step + 1
            ahead = [state for state in range(LENGTH + 1) if first <= state <= step + most_ahead]
            kinds = {KINDS[episode, state] for state in ahead}
            for state in ahead:
                alike = sum(KINDS[episode, other] == KINDS[episode, state] for other in ahead)
                of_kind = share[KINDS[episode, state]] / sum(share[kind] for kind in kinds) if len(kinds) > 1 else 1
                of_state = float(state == ahead[-1]) if strategy == FINAL else of_kind / alike
                probability[episode, step, state] = one * p_ht * of_state
    return probability


@pytest.mark.parametrize(
    ("p_ht", "strategy", "most_ahead", "current"),
    [
        (0.0, FUTURE, 2**30, False),
        (1.0, FUTURE, 2**30, False),
        (0.7, FUTURE, 2**30, False),
        (1.0, FUTURE, 1, False),
        (1.0, FUTURE, 3, False),
        (1.0, FUTURE, 2**30, True),
        (0.3, FINAL, 2**30, False),
        (1.0, FINAL, 2, False),
    ],
)
def test_episodes_steps_and_sources_are_drawn_by_the_law(p_ht, strategy, most_ahead, current):
    found = origin(drawn(full(), jax.random.key(0), p_ht, strategy, most_ahead, current=current))
    counts = dict.fromkeys(law(p_ht, strategy, most_ahead, current=current), 0)
    for episode, step, _, source in zip(*found, strict=True):
        counts[int(episode), int(step), int(source)] += 1  # anything else has no key: backwards, or too far ahead
    expected = law(p_ht, strategy, most_ahead, current=current)
    assert sum(expected.values()) == pytest.approx(1)
    assert all(counts[key] == 0 for key, probability in expected.items() if probability == 0)
    keys = [key for key, probability in expected.items() if probability > 0]
    seen, wanted = (np.array([table[key] for key in keys], float) for table in (counts, expected))
    assert chisquare(seen, wanted / wanted.sum() * DRAWS).pvalue > UNLIKELY
    assert np.abs(seen / DRAWS - wanted).max() < 0.005


def test_kinds_are_weighed_by_the_sound_episodes_alone():
    """Without the only episode that pursues kind 1, that kind is drawn only where no other lies ahead."""
    episode, step, _, source = origin(drawn(full([True, False, True, True]), jax.random.key(1), 1.0))
    others = np.array([(KINDS[one, at + 1 :] == 0).any() for one, at in zip(episode, step, strict=True)])
    assert (KINDS[episode, source] == 0)[others].all()
    assert (KINDS[episode, source] == 1)[~others].all()
    assert (~others).any()


@pytest.mark.parametrize("p_ht", [0.0, 0.5, 1.0])
def test_a_sample_is_the_step_under_its_goal(p_ht):
    valid, solved_weight = np.array([True, True, False, True]), 0.25
    given = trajectory(range(HELD), valid)
    sample = drawn(full(valid), jax.random.key(2), p_ht, solved_weight=solved_weight)
    episode, step, chosen, source = origin(sample)
    features, achieved, desired = (np.asarray(leaf) for leaf in (given.features, given.achieved, given.desired))
    goal = np.where(chosen[:, None], achieved[source, episode], desired[step, episode])
    np.testing.assert_array_equal(sample.observation, np.concatenate([features[step, episode], goal], axis=-1))
    np.testing.assert_array_equal(sample.next_observation, np.concatenate([features[step + 1, episode], goal], axis=-1))
    np.testing.assert_array_equal(sample.action, np.clip(np.asarray(given.action), -1, 1)[step, episode])
    reached = np.abs(achieved[step + 1, episode] - goal)[:, 0] <= 1.0
    np.testing.assert_array_equal(sample.reached, reached & (features[step + 1, episode, 0] > 0))
    weight = valid[episode] * np.where(chosen & (source == step + 2), solved_weight, 1.0)
    np.testing.assert_array_equal(sample.weight, weight.astype(np.float32))
    assert reached.any()
    assert (weight == 0).any()
    assert (weight == solved_weight).any() == (p_ht > 0)
    assert binomtest(int(chosen.sum()), DRAWS, p_ht).pvalue > UNLIKELY


def test_a_goal_that_was_pursued_weighs_in_full_though_it_is_solved():
    given = trajectory(range(HELD))
    solved = given.replace(desired=given.desired.at[..., 0].add(1.6))  # two steps ahead
    sample = drawn(add(init_buffer(ENV, HELD), solved), jax.random.key(0), 0.0, solved_weight=0.25)
    assert (sample.weight == 1.0).all()


@pytest.mark.parametrize("count", [1, 3])
def test_places_that_are_empty_are_never_drawn(count):
    buffer = add(init_buffer(ENV, HELD), trajectory(range(1, 1 + count)))
    episode = origin(drawn(buffer, jax.random.key(3), 0.5))[0]
    assert set(episode) == set(range(1, 1 + count))


def test_seeds_side_by_side_draw_what_each_draws_alone():
    buffers = [full(), add(full([True, False, True, True]), trajectory([6]))]
    rngs, p_ht, most_ahead = jax.random.split(jax.random.key(4)), np.float32([0.4, 1.0]), np.array([2**30, 2])
    one = functools.partial(drawn, count=200)
    both = jax.tree.map(lambda *leaves: np.stack(leaves), *buffers)
    draw_both = jax.jit(jax.vmap(lambda *given: one(*given[:3], FUTURE, given[3])))
    together = jax.device_get(draw_both(both, rngs, p_ht, most_ahead))
    for index, buffer in enumerate(buffers):
        alone = one(buffer, rngs[index], p_ht[index], FUTURE, most_ahead[index])
        jax.tree.map(
            lambda ours, all_of_them, i=index: np.testing.assert_array_equal(ours, all_of_them[i]), alone, together
        )


# Samples of the discriminator


class Corners(Line):
    """Two states and two goals, of which a state achieves its own."""

    goal_size, goal_kinds, success_threshold = 1, 1, 0.25

    def goal_kind(self, goal):
        return jnp.zeros(goal.shape[:-1], jnp.int32)


CORNERS = Corners()  # one, by which JAX finds the programs again
positives, negatives = (jax.jit(function, static_argnums=(0, 3)) for function in (draw_positives, draw_negatives))
_AHEAD = math.lcm(*range(1, LENGTH + 1))  # so that every step counts as often, however many lie ahead of it


@pytest.fixture(scope="module")
def corners():
    """A buffer of random episodes; the states, goals achieved next, goals pursued of its steps, and all goals later."""
    rng = np.random.default_rng(0)
    state = (rng.uniform(size=(LENGTH + 1, HELD)) < 0.4).astype(np.float32)
    wanted = (rng.uniform(size=(LENGTH + 1, HELD)) < 0.3 + 0.4 * state).astype(np.float32)  # depends on the state
    zeros = np.zeros((LENGTH, HELD), np.float32)
    episodes = Trajectory(
        features=state[..., None],
        achieved=state[..., None],
        desired=wanted[..., None],
        action=np.zeros((LENGTH, HELD, 2), np.float32),
        noted=zeros,
        reward=zeros,
        valid=np.ones(HELD, bool),
        overflow=np.zeros(HELD, bool),
        outcome=EpisodeMetrics(),
    )
    buffer = add(init_buffer(CORNERS, HELD), jax.tree.map(jnp.asarray, episodes))
    later = [
        (state[step, episode], goal)
        for step in range(LENGTH)
        for episode in range(HELD)
        for goal in np.repeat(state[step + 1 :, episode], _AHEAD // (LENGTH - step))
    ]
    return buffer, state[:-1].ravel(), state[1:].ravel(), wanted[:-1].ravel(), np.array(later).T


def joint(states, goals):
    """Returns the frequencies of pairs, `[2, 2]`."""
    counts = np.zeros((2, 2))
    np.add.at(counts, (np.rint(states).astype(int), np.rint(goals).astype(int)), 1.0)
    return counts / counts.sum()


def product(density):
    """Returns the density of pairs whose parts are drawn independently."""
    return density.sum(axis=1, keepdims=True) * density.sum(axis=0, keepdims=True)


@jax.jit
@jax.grad
def slope(logits, expert, policy, weight):
    """Gradient of the discriminator's loss by its logits, `[2, 2]`, of samples of states and goals, `[B, 2]`."""
    cells = (jnp.rint(observation).astype(int) for observation in (expert, policy))
    return discriminator_loss(*(logits[cell[:, 0], cell[:, 1]] for cell in cells), weight)


@pytest.mark.parametrize(
    ("changes", "negative"),
    [
        ({}, "pursued"),
        ({"shuffled_goals": 1.0}, "any"),
        ({"shuffled_goals": 0.5}, "half"),
        ({"negative_p_ht": 1.0}, "later"),
        ({"shuffled_goals": 0.5, "negative_p_ht": 0.6}, "mixed"),
        ({"shuffled_goals": 1.0, "goal_jitter": 1.0, "negative_weight": 3.0}, "any"),
    ],
)
def test_the_best_logit_is_the_log_ratio_of_the_densities(corners, changes, negative):
    """log p(state, goal achieved next) - log w q(state, goal), with q of goals pursued, achieved later, or of any."""
    buffer, state, achieved, pursued, later = corners
    hyper, keys = ReplayHyperparameters(discriminator_horizon=1, **changes), jax.random.split(jax.random.key(1), 4)
    expert = positives(CORNERS, hyper, buffer, 200_000, *keys[:2])
    policy = negatives(CORNERS, hyper, buffer, 200_000, *keys[2:])
    together, hindsight = joint(state, pursued), joint(*later)
    mixed = 0.4 * together + 0.6 * hindsight
    density = {
        "pursued": together,
        "later": hindsight,
        "any": product(together),
        "half": 0.5 * (together + product(together)),
        "mixed": 0.5 * (mixed + product(mixed)),
    }[negative]
    weight = changes.get("negative_weight", 1.0)
    best = np.log(joint(state, achieved)) - np.log(weight * density)

    gradient = functools.partial(slope, expert=expert.observation, policy=policy.observation, weight=weight)
    np.testing.assert_allclose(gradient(jnp.asarray(best, jnp.float32)), 0.0, atol=5e-3)
    assert np.abs(gradient(jnp.asarray(best + 0.2, jnp.float32))).max() > 0.01
    exact = np.abs(np.asarray(expert.observation[:, 1]) - np.rint(expert.observation[:, 1])).max()
    assert exact == 0.0 if not changes.get("goal_jitter") else 0.24 < exact <= 0.25


def test_shuffling_pairs_no_sample_with_its_own_goal():
    goals = jnp.arange(7.0)[:, None]
    shuffled = shuffle_goals(goals, 1.0, jax.random.key(0))
    assert sorted(shuffled[:, 0].tolist()) == list(range(7))
    assert (shuffled != goals).all()
    np.testing.assert_array_equal(shuffle_goals(goals, 0.0, jax.random.key(0)), goals)


def test_achieved_goals_are_drawn_of_sound_episodes_each_kind_as_often():
    goals = np.asarray(goals_of(ENV, full([True, False, True, True]), jax.random.key(0), 2000))
    place, kind = goals[:, 0].astype(int), goals[:, 1]
    episode, step = place // 100, place % 100
    assert set(episode) == {0, 2, 3} and set(step) == set(range(1, LENGTH + 1))
    np.testing.assert_array_equal(kind, KINDS[episode, step])
    assert binomtest(int(kind.sum()), len(kind), 0.5).pvalue > UNLIKELY
    # within a kind each step is as likely as the others
    for which in (0, 1):
        of_kind = [(n, t) for n in (0, 2, 3) for t in range(1, LENGTH + 1) if KINDS[n, t] == which]
        counts = [int(((episode == n) & (step == t)).sum()) for n, t in of_kind]
        assert chisquare(counts).pvalue > UNLIKELY


def test_where_nothing_sound_was_achieved_a_goal_is_drawn_all_the_same():
    for buffer in (init_buffer(ENV, HELD), full([False] * HELD)):
        assert np.isfinite(goals_of(ENV, buffer, jax.random.key(0), 2000)).all()


@pytest.mark.parametrize("discount", [0.0, 0.6, 0.99])
def test_later_goals_are_as_many_steps_ahead_as_a_discount_says(discount):
    buffer, rng = full(), jax.random.key(8)
    samples = drawn(buffer, jax.random.key(9), 0.0)
    goal = np.asarray(jax.jit(draw_future)(buffer, samples, discount, rng))
    place = np.rint(goal[:, 0]).astype(int)
    np.testing.assert_array_equal(place // 100, samples.episode)
    np.testing.assert_array_equal(goal[:, 1], KINDS[place // 100, place % 100])
    ahead = place % 100 - np.asarray(samples.step)
    for step in range(LENGTH):
        chance = np.array([discount**count for count in range(LENGTH - step)])
        counts = np.bincount(ahead[samples.step == step], minlength=LENGTH - step + 1)
        assert counts[0] == 0 and len(counts) == LENGTH - step + 1
        possible = chance > 0
        assert counts[1:][~possible].sum() == 0
        expected = chance[possible] / chance.sum() * counts.sum()
        assert possible.sum() == 1 or chisquare(counts[1:][possible], expected).pvalue > UNLIKELY

"""Where expert samples come from: relabelled, kept, demonstrated, or of the best episodes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hgail_jax import METHODS, PPO, Config, Hyperparameters, Preset, init_state
from hgail_jax.config import BEST, DEMONSTRATIONS, FROZEN, RELABELLED
from hgail_jax.experts import BestEpisodes, expert_samples, init_expert, keep_best
from hgail_jax.learner import DISCRIMINATOR, POLICY, PRETRAIN
from hgail_jax.samples import Samples, flatten, relabelled_samples
from tests.hgail_jax.line import ENV, EPISODES, LENGTH, assert_same, trajectory
from tests.support import TINY

MINE = Samples(jnp.ones((7, 3)), jnp.ones((7, 1)), jnp.arange(7.0))


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
        observation = np.concatenate([given.features, given.desired], axis=-1)
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
                kept, episode = jax.tree.map(lambda leaf, at=place: leaf[:, at], best.samples), number % EPISODES
                np.testing.assert_array_equal(kept.action, given.action[:, episode])
                np.testing.assert_array_equal(kept.observation, observation[:-1, episode])


def test_places_that_no_valid_episode_fills_have_no_weight():
    valid = np.arange(EPISODES) < 3
    hyper = Hyperparameters()
    best = jax.jit(functools.partial(keep_best, ENV, hyper))(best_episodes(5), trajectory(valid=valid))
    np.testing.assert_array_equal(best.samples.weight, np.broadcast_to([1, 1, 1, 0, 0], (LENGTH, 5)))
    assert (np.asarray(best.returns)[3:] == np.finfo(np.float32).min).all()
    empty = best_episodes(5)
    assert isinstance(empty, BestEpisodes)
    assert empty.samples.observation.shape == (LENGTH, 5, 3)
    assert empty.samples.action.shape == (LENGTH, 5, 1)
    assert all((leaf == 0).all() for leaf in jax.tree.leaves(empty.samples))
    np.testing.assert_array_equal(empty.returns, np.full(5, np.finfo(np.float32).min))
    np.testing.assert_array_equal(empty.distance, np.zeros(5))


relabelled = jax.jit(relabelled_samples, static_argnums=0)
samples_of = jax.jit(expert_samples, static_argnums=(0, 1))


def learn_from(source, expert, given, seed=0):
    config, key = Config(PPO(), expert_source=source, best_episodes=5, num_envs=EPISODES), jax.random.key(seed)
    return samples_of(ENV, config, jax.tree.map(jnp.asarray, Hyperparameters()), expert, given, key)


def test_each_source_gives_its_expert_samples():
    first, second = trajectory(valid=np.arange(EPISODES) > 1), trajectory(valid=np.arange(EPISODES) > 4)
    fresh = relabelled(ENV, jax.tree.map(jnp.asarray, Hyperparameters()), first, jax.random.key(0))
    kept, samples = learn_from(RELABELLED, None, first)
    assert kept is None
    assert_same(samples, fresh)
    frozen = init_expert(ENV, Config(PPO(), expert_source=FROZEN, num_envs=EPISODES), None)
    assert_same(frozen, jax.tree.map(jnp.zeros_like, fresh))
    for given, seed in ((first, 0), (second, 1)):
        frozen, samples = learn_from(FROZEN, frozen, given, seed)
        assert_same((frozen, samples), (fresh, fresh))
    config = Config(PPO(), expert_source=DEMONSTRATIONS)
    assert_same(init_expert(ENV, config, MINE), MINE)
    assert_same(learn_from(DEMONSTRATIONS, MINE, first), (MINE, MINE))
    best, samples = learn_from(BEST, best_episodes(5), second)
    keep = jax.jit(functools.partial(keep_best, ENV, Hyperparameters()))
    assert_same(best, keep(best_episodes(5), second))
    assert_same(samples, flatten(best.samples))
    assert init_expert(ENV, Config(PPO()), None) is None


@pytest.mark.parametrize(
    ("config", "changes", "message"),
    [
        ({}, {}, "expert_source is 'relabelled' and demonstrations are given"),
        ({"expert_source": DEMONSTRATIONS}, None, "expert_source is 'demonstrations' and none are given"),
        ({"expert_source": DEMONSTRATIONS}, {"observation": jnp.ones((7, 4))}, r"must be \[S, 3\], \[S, 1\] and \[S\]"),
        ({"expert_source": DEMONSTRATIONS}, {"action": jnp.ones((7, 2))}, r"must be \[S, 3\], \[S, 1\] and \[S\]"),
        ({"expert_source": DEMONSTRATIONS}, {"weight": jnp.ones(6)}, r"must be \[S, 3\], \[S, 1\] and \[S\]"),
        ({"expert_source": DEMONSTRATIONS}, {"weight": jnp.ones(())}, r"must be \[S, 3\], \[S, 1\] and \[S\]"),
    ],
)
def test_demonstrations_must_fit(config, changes, message):
    given = None if changes is None else MINE.replace(**changes)
    with pytest.raises(ValueError, match=message):
        init_expert(ENV, Config(PPO(), **config), given)


def test_an_unknown_source_is_refused():
    with pytest.raises(ValueError, match="expert_source is 'dreams'; it must be one of relabelled, frozen"):
        Config(PPO(), expert_source="dreams")


def test_every_update_lets_its_roll_out_enter_the_buffer():
    config = METHODS["gasil"].apply(Preset(TINY.replace(best_episodes=5, num_envs=EPISODES), Hyperparameters())).config

    @jax.jit
    def filled(rng, given):
        state = init_state(ENV, config, Hyperparameters(), rng)
        updates = config.learner.phase_updates()
        after = {phase: update(ENV, config, state, given, rng)[0] for phase, update in updates.items()}
        return state.expert.samples.weight.sum(), {name: of.expert.samples.weight.sum() for name, of in after.items()}

    before, after = filled(jax.random.key(0), trajectory(valid=np.arange(EPISODES) < 4))
    assert before == 0.0
    assert after == dict.fromkeys((PRETRAIN, POLICY, DISCRIMINATOR), 4 * LENGTH)

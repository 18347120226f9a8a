"""An update that is not finite is undone and counted; the other seeds, and the run, continue."""

import dataclasses
import functools
import json

import jax
import numpy as np
import pytest

import hgail_envs
from hgail_jax import Hyperparameters, RoundMetrics, check_metrics, phase_table
from hgail_jax.learner import DISCRIMINATOR, EVALUATE, POLICY, PRETRAIN, SKIP
from hgail_jax.seeds import init_sweep, seed_keys
from hgail_jax.trainer.loop import Program, begin, diverged_seeds, train
from tests.support import TINY, copied, init_once

ENV = hgail_envs.make("point")
SOUND = Hyperparameters()
# With such steps the weights of one network overflow in their second; the other's are as ever.
DIVERGES = SOUND.replace(policy_learning_rate=1e38)
DISCRIMINATOR_DIVERGES = SOUND.replace(discriminator_learning_rate=1e38)
SETTINGS = SOUND, DIVERGES, DISCRIMINATOR_DIVERGES


@functools.cache
def begun(*numbers):
    return init_sweep(ENV, TINY, [SETTINGS[number] for number in numbers], seed_keys(0, 1))


def start(*settings):
    return copied(begun(*map(SETTINGS.index, settings)))


def one(states, index):
    """Returns the numbers of one of the settings, without its key."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], states.replace(rng=None, hyperparameters=None))


def assert_same(left, right):
    jax.tree.map(np.testing.assert_array_equal, left, right)


def row(*phases):
    return np.array([*phases, *[SKIP] * (phase_table(TINY).shape[1] - len(phases))])


def test_a_round_that_diverges_for_one_leaves_the_others_to_the_bit_what_they_are_without_it(step_of_two):
    (mixed, among), (sound, apart) = (
        step_of_two(start(SOUND, other), row(PRETRAIN, POLICY)) for other in (DIVERGES, SOUND)
    )
    assert_same(one(mixed, 0), one(sound, 0))
    np.testing.assert_array_equal(among.diverged, [0.0, 1.0])
    np.testing.assert_array_equal(apart.diverged, [0.0, 0.0])
    check_metrics(among)


@pytest.mark.parametrize(
    ("phase", "diverges"), [(PRETRAIN, DIVERGES), (POLICY, DIVERGES), (PRETRAIN, DISCRIMINATOR_DIVERGES)]
)
def test_an_update_that_diverges_is_undone_in_all_its_parts(step_of_two, phase, diverges):
    before = one(start(SOUND, diverges), 1)
    after, metrics = step_of_two(start(SOUND, diverges), row(phase))
    assert_same(one(after, 1), before)
    np.testing.assert_array_equal(metrics.diverged, [0.0, 1.0])


def test_what_can_be_learnt_in_a_round_that_diverges_is_learnt(step_of_two):
    """The discriminator's phase is not undone with the policy's; and an evaluation is none of the updates counted."""
    after, metrics = step_of_two(start(SOUND, DIVERGES), row(POLICY, POLICY, DISCRIMINATOR, EVALUATE))
    before = one(start(SOUND, DIVERGES), 1)
    assert_same(one(after, 1).learner.actor_critic, before.learner.actor_critic)
    assert not np.array_equal(*(jax.tree.leaves(state.discriminator)[1] for state in (one(after, 1), before)))
    np.testing.assert_allclose(metrics.diverged, [0.0, 2 / 3], rtol=1e-6)
    assert np.isfinite(metrics.evaluation.distance_l1).all()


def test_each_try_has_data_of_its_own(step_of_two):
    """The key is not undone, so that a seed that diverged by bad luck can continue."""
    states = start(SOUND, DIVERGES)
    keys = np.asarray(jax.random.key_data(states.rng))
    after, _ = step_of_two(states, row(POLICY))
    assert (np.asarray(jax.random.key_data(after.rng)) != keys).any(axis=1).all()


def metrics_of(**changes):
    """Metrics of two seeds in which nothing is wrong, but for the changes."""
    fields = {field.name: np.zeros(2) for field in dataclasses.fields(RoundMetrics)}
    return RoundMetrics(**(fields | {name: np.array(value) for name, value in changes.items()}))


@pytest.mark.parametrize("diverged", [[0.0, 0.0], [1.0, 0.0], [np.inf, np.inf], [0.1, np.inf]])
def test_a_round_in_which_some_seed_learns_is_taken(diverged):
    check_metrics(metrics_of(diverged=diverged, overflow=[np.nan, np.inf]))


def test_a_round_in_which_no_seed_learns_or_one_overflows_is_refused():
    with pytest.raises(FloatingPointError, match=r"^no seed's update is finite$"):
        check_metrics(metrics_of(diverged=[0.2, 1.0]))
    with pytest.raises(FloatingPointError):
        check_metrics(metrics_of(diverged=0.5))
    with pytest.raises(OverflowError, match=r"^the simulation ran out of room for contacts$"):
        check_metrics(metrics_of(overflow=[0.0, 1e-4], diverged=[1.0, 1.0]))


def test_a_round_without_a_sound_episode_is_refused():
    check_metrics(metrics_of(dropped=[1.0, 0.99]))
    for dropped in ([1.0, 1.0], 1.0):
        with pytest.raises(FloatingPointError, match=r"^the simulation of every episode broke down$"):
            check_metrics(metrics_of(dropped=dropped))
    with pytest.raises(FloatingPointError):
        check_metrics(metrics_of(dropped=[0.0, 1.0], diverged=[1.0, 0.0]))


@pytest.fixture(autouse=True)
def initialised_once(monkeypatch):
    init_once(monkeypatch)


def program(*settings):
    return Program(ENV, TINY, settings, seeds=1, first_seed=3)


def test_a_training_continues_with_those_that_do_not_diverge_and_names_those_that_do(step_of_two):
    mixed = program(SOUND, DIVERGES)
    progress = begin(mixed, mixed.init())
    train(mixed, step_of_two, progress)
    assert progress.rounds == 3
    np.testing.assert_allclose(
        [record["diverged_rate"] for record in progress.history], [[0, 1], [0, 2 / 3], [0, 2 / 3]]
    )
    assert diverged_seeds(mixed, progress) == ["seed 3 of setting 1"]
    json.dumps(progress.history, allow_nan=False)  # what was not finite is None
    assert progress.history[1]["policy_loss"][1] is None
    alone = program(SOUND, SOUND)
    of_sound = begin(alone, alone.init())
    train(alone, step_of_two, of_sound)
    assert_same(one(progress.states, 0), one(of_sound.states, 0))
    assert diverged_seeds(alone, of_sound) == []

"""The training loop, with steps that return what they are given."""

import dataclasses
import functools
import json
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hgail_envs
from hgail_jax import Checkpoints, EpisodeMetrics, Hyperparameters, RoundMetrics, phase_table
from hgail_jax.learners import PPO
from hgail_jax.train import EVALUATE, SKIP
from hgail_jax.trainer import loop
from hgail_jax.trainer.loop import Program, SavingPolicy, begin, diverged_seeds, round_record, save, train
from tests.support import TINY, copied

ENV = hgail_envs.make("point")

NAN = float("nan")


def program(rounds=7, seeds=2, **changes):
    return Program(ENV, dataclasses.replace(TINY, rounds=rounds), (Hyperparameters(),), seeds, **changes)


def measured(success, distance, **changes):
    """What a round of as many seeds as there are distances measured."""
    zero = np.zeros(len(distance))
    episodes = EpisodeMetrics(np.array(success), zero, zero, np.array(distance), np.array(distance))
    update = {name: zero + 0.5 for name in PPO.metrics}
    return RoundMetrics(
        **(
            {"evaluation": episodes, "training": episodes, "update": update}
            | changes
            | {name: changes.get(name, zero) for name in ("dropped", "overflow", "diverged")}
        )
    )


def steps_of(*rounds, given=None):
    """A step that returns these metrics, one after another, and states in which each round has left its mark.

    It adds the phases of each round to the list `given`.
    """
    coming = iter(rounds)

    def step(states, phases):
        if given is not None:
            given.append(phases.tolist())
        return states.replace(expert=states.expert + 1), next(coming)

    return step


@functools.cache
def untrained(seeds):
    return program(seeds=seeds).init()


def start(of):
    progress = begin(of, copied(untrained(of.seeds)))
    return dataclasses.replace(progress, states=progress.states.replace(expert=jnp.zeros(of.seeds)))


def saved(folder):
    return sorted(int(path.name) for path in folder.iterdir() if path.is_dir())


def test_a_round_in_which_every_episode_broke_is_never_the_best(tmp_path):
    """Its success is 0, as in the others; and its distance is not 0, which would be the best, but none at all."""
    distances = [0.3, 0.2, NAN, 0.4, 0.5, 0.6, 0.7, 0.8]
    rounds = [measured([0.0, 0.0], [distance, distance]) for distance in distances]
    progress = start(program())
    with Checkpoints(tmp_path / "checkpoints", {}) as checkpoints:
        train(program(), steps_of(*rounds), progress, checkpoints)
    assert saved(tmp_path / "checkpoints") == [2, 6, 7, 8]
    assert progress.history[2]["distance_l1"] == [None, None]
    json.dumps(progress.history, allow_nan=False)


def test_where_the_episodes_of_one_seed_broke_the_others_are_scored():
    progress = start(program())
    train(program(rounds=0), steps_of(measured([0.0, 0.5], [NAN, 0.3])), progress)
    assert progress.score() == (0.25, -0.3)
    assert dataclasses.replace(progress, history=[{"success_rate": [0.0], "distance_l1": [None]}]).score() is None


def test_success_comes_before_distance(tmp_path):
    rounds = [measured([success] * 2, [distance] * 2) for success, distance in [(0.5, 0.1), (0.9, 0.6), (0.9, 0.5)]]
    rounds += [measured([0.2] * 2, [0.01] * 2)] * 5
    with Checkpoints(tmp_path / "checkpoints", {}) as checkpoints:
        train(program(), steps_of(*rounds), start(program()), checkpoints)
    assert saved(tmp_path / "checkpoints") == [3, 6, 7, 8]


def test_a_round_is_recorded_and_shown_before_it_is_saved(tmp_path):
    seen, given = [], []
    with Checkpoints(tmp_path / "checkpoints", {}) as checkpoints:
        rounds = [measured([0.0, 0.25 * index], [0.1, 0.2]) for index in range(3)]
        progress = start(program(rounds=2))

        def watch(progress):
            seen.append((progress.rounds, progress.history[-1]["success_rate"], checkpoints.saved))

        train(program(rounds=2), steps_of(*rounds, given=given), progress, checkpoints, after_round=watch)
    assert given == phase_table(dataclasses.replace(TINY, rounds=2)).tolist()
    assert seen == [(1, [0.0, 0.0], None), (2, [0.0, 0.25], 1), (3, [0.0, 0.5], 2)]
    np.testing.assert_array_equal(progress.states.expert, 3.0)
    assert [record["env_steps"] for record in progress.history] == [200, 800, 1400]
    assert [record["round"] for record in progress.history] == [0, 1, 2]
    assert 0 <= progress.history[0]["seconds"] <= progress.history[2]["seconds"] <= progress.seconds + 1e-3


@pytest.mark.parametrize(
    ("saving", "kept"),
    [(SavingPolicy(rounds=3), [3, 6, 8]), (SavingPolicy(rounds=100), [8]), (SavingPolicy(seconds=3600.0), [8])],
)
def test_checkpoints_are_saved_when_they_are_due_and_at_the_end(tmp_path, saving, kept):
    rounds = [measured([0.0] * 2, [1.0] * 2)] * 8
    with Checkpoints(tmp_path / "checkpoints", {}) as checkpoints:
        train(program(), steps_of(*rounds), start(program()), checkpoints, saving)
    assert saved(tmp_path / "checkpoints") == kept


@pytest.mark.parametrize(
    ("most", "expected"), [(1.0, [1, 2, 3, 4, 5, 6, 7, 8]), (0.25, [1, 4, 7, 8]), (0.2, [1, 5, 8]), (0.05, [1, 8])]
)
def test_saving_takes_no_more_than_its_fraction_of_the_time(monkeypatch, most, expected):
    """By a clock of which a round takes 1, and saving 1: of four rounds' time three pass until saving is a quarter."""
    clock, rounds, step = [0.0], [], steps_of(*[measured([0.0] * 2, [1.0] * 2)] * 8)
    monkeypatch.setattr(loop.time, "perf_counter", lambda: clock[0])

    def timed(*arguments):
        clock[0] += 1.0
        return step(*arguments)

    def save_timed(_, progress):
        clock[0] += 1.0
        rounds.append(progress.rounds)

    monkeypatch.setattr(loop, "save", save_timed)
    train(program(), timed, start(program()), saving=SavingPolicy(most=most))
    assert list(dict.fromkeys(rounds)) == expected  # the last round's is asked for once more at the end


def test_a_round_that_is_refused_is_neither_recorded_nor_saved(tmp_path):
    valid, full = measured([0.0] * 2, [1.0] * 2), measured([0.0] * 2, [1.0] * 2, overflow=np.array([0.0, 0.1]))
    progress = start(program())
    refused = pytest.raises(OverflowError, match="the simulation ran out of room for contacts in round 2")
    with Checkpoints(tmp_path / "checkpoints", {}) as checkpoints, refused:
        train(program(), steps_of(valid, valid, full), progress, checkpoints)
    assert progress.rounds == 2
    assert saved(tmp_path / "checkpoints") == [1, 2]


def test_a_training_that_is_stopped_ends_with_its_round_and_a_checkpoint(tmp_path):
    stop, progress = threading.Event(), start(program())
    rounds = [measured([0.0] * 2, [1.0] * 2)] * 8

    def stop_after_two(progress):
        if progress.rounds == 2:
            stop.set()

    with Checkpoints(tmp_path / "checkpoints", {}) as checkpoints:
        train(program(), steps_of(*rounds), progress, checkpoints, SavingPolicy(10), stop, stop_after_two)
    assert progress.rounds == 2
    assert saved(tmp_path / "checkpoints") == [2]
    train(program(), steps_of(), progress, stop=stop)  # it stays stopped
    train(program(), steps_of(*rounds[2:]), progress)
    assert progress.rounds == 8


def test_a_resumed_training_remembers_its_rounds_and_the_seeds_that_diverged(tmp_path):
    of, rounds = (
        program(rounds=2),
        [measured([0.0] * 2, [1.0] * 2, diverged=np.array([0.0, rate])) for rate in (0.5, 0)],
    )
    with Checkpoints(tmp_path / "checkpoints", {}) as checkpoints:
        first = start(of)
        train(program(rounds=1), steps_of(*rounds), first, checkpoints)
    with Checkpoints(tmp_path / "checkpoints", {}) as checkpoints:
        resumed = begin(of, untrained(of.seeds), checkpoints.restore(first.states))
        assert (resumed.history, resumed.seconds, resumed.saved) == (first.history, first.seconds, 2)
        train(of, steps_of(rounds[1]), resumed, checkpoints)
    assert diverged_seeds(of, resumed) == ["seed 1"]
    assert Checkpoints(tmp_path / "checkpoints", {}).restore(first.states).history == resumed.history


def test_a_round_is_saved_once(tmp_path):
    progress = start(program(rounds=0))
    with Checkpoints(tmp_path / "checkpoints", {}) as checkpoints:
        save(checkpoints, progress)  # nothing is done yet
        assert checkpoints.saved is None
        train(program(rounds=0), steps_of(measured([0.0] * 2, [1.0] * 2)), progress, checkpoints)
        save(checkpoints, progress)
    assert saved(tmp_path / "checkpoints") == [1]
    save(None, progress)


@pytest.mark.parametrize(("every", "evaluated"), [(1, [0, 1, 2, 3, 4, 5, 6, 7]), (3, [0, 3, 6, 7]), (100, [0, 7])])
def test_evaluations_are_left_out_between_and_never_at_the_end(every, evaluated):
    last = program(evaluate_every=every).phases()[:, -1]
    assert np.flatnonzero(last == EVALUATE).tolist() == evaluated
    assert set(last[np.delete(np.arange(8), evaluated)]) <= {SKIP}


def test_seeds_are_named_by_their_number_and_by_their_setting_where_there_are_several():
    assert [program(seeds=2, first_seed=5).label(index) for index in range(2)] == ["seed 5", "seed 6"]
    several = dataclasses.replace(program(seeds=2, first_seed=5), settings=(Hyperparameters(),) * 2)
    assert several.label(3) == "seed 6 of setting 1"


def test_what_was_not_measured_is_none():
    record = round_record(measured([0.5, NAN], [NAN, np.inf], diverged=np.array([NAN, 1.0])), 4, 100, 1.23456)
    assert record["success_rate"] == [0.5, None]
    assert record["distance_l1"] == [None, None]
    assert record["diverged_rate"] == [None, 1.0]
    assert (record["round"], record["env_steps"], record["seconds"]) == (4, 100, 1.235)


def test_a_training_begins_with_its_seeds_own_states():
    of = program(seeds=2, first_seed=5)
    progress = begin(of, of.init())
    for index in range(2):
        one = program(seeds=1, first_seed=5 + index)
        alone = begin(one, one.init()).states
        jax.tree.map(
            lambda ours, theirs, i=index: np.testing.assert_array_equal(ours[i], theirs[0]),
            jax.device_get(progress.states.replace(rng=None)),
            jax.device_get(alone.replace(rng=None)),
        )
    assert (progress.rounds, progress.seconds) == (0, 0.0)

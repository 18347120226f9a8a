"""The trainer as a notebook uses it: no command line, no signals."""

import csv
import json
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest

import hgail_envs
from hgail_jax import Trainer, TrainOptions
from hgail_jax.trainer import curves, results
from tests.support import compile_once, make_runs_tiny

SMALL = TrainOptions(task="point", seeds=2, num_envs=4, iterations=4)  # as `test_resume` has it


@pytest.fixture(autouse=True)
def tiny(monkeypatch, tmp_path):
    make_runs_tiny(monkeypatch)
    compile_once(monkeypatch)
    monkeypatch.chdir(tmp_path)


class After(threading.Event):
    """An event that sets itself once the training has asked for it so many times."""

    def __init__(self, times):
        super().__init__()
        self.left = times

    def is_set(self):
        self.left -= 1
        if self.left < 0:
            self.set()
        return super().is_set()


def table(folder):
    with (folder / "metrics.csv").open() as file:
        return [row | {"seconds": ""} for row in csv.DictReader(file)]


def bits(folder):
    """All that a run of `SMALL` computed."""
    record = json.loads((folder / "checkpoints" / "5" / "record" / "metadata").read_text())
    return table(folder), record["body"]["arrays"]


def test_each_seed_has_its_own_policy():
    """That of the last checkpoint, which says itself which seed is which."""
    with Trainer(SMALL) as trainer:
        trainer.open()
        trainer.train()
        states = trainer.checkpoints.restore(jax.eval_shape(trainer.run.program().init)).state
    layers = [states.actor_critic["policy"]["params"][f"Dense_{index}"] for index in range(3)]
    for seed in range(SMALL.seeds):
        policy = trainer.policy(seed)
        np.testing.assert_array_equal(policy.mean, states.statistics.mean[seed])
        for (weights, biases), layer in zip(policy.layers, layers, strict=True):
            np.testing.assert_array_equal(weights, layer["kernel"][seed])
            np.testing.assert_array_equal(biases, layer["bias"][seed])


def test_the_final_evaluation_is_traced_before_the_first_round(monkeypatch):
    traced, trace, rounds = threading.Event(), Trainer._trace_evaluations, Trainer._train_rounds

    def trace_slowly(self):
        time.sleep(1.0)
        found = trace(self)
        traced.set()
        return found

    def train_rounds(self, *arguments):
        assert traced.is_set()
        return rounds(self, *arguments)

    monkeypatch.setattr(Trainer, "_trace_evaluations", trace_slowly)
    monkeypatch.setattr(Trainer, "_train_rounds", train_rounds)
    Trainer(SMALL).train()


def test_the_physics_is_prepared_before_the_first_round(monkeypatch):
    prepared, rounds = [], Trainer._train_rounds

    def prepare(self):
        time.sleep(1.0)
        prepared.append(self)

    def train_rounds(self, *arguments):
        assert len(prepared) == 1
        return rounds(self, *arguments)

    monkeypatch.setattr(hgail_envs.registry.find_class("point"), "prepare", prepare)
    monkeypatch.setattr(Trainer, "_train_rounds", train_rounds)
    Trainer(SMALL).train()


def test_a_run_in_a_notebook():
    trainer = Trainer(SMALL)
    assert not Path("runs").exists()  # nothing is written before the training
    summary = trainer.train()
    assert trainer.folder == Path("runs/point-hgail-1")
    written = json.loads((trainer.folder / "summary.json").read_text())
    assert {name: written[name] for name in summary} == summary
    assert written["commit"] is None or len(written["commit"]) >= 7
    assert trainer.checkpoints.saved == 5
    policy = trainer.policy(seed=1)
    assert policy.task == "point"
    assert policy(np.zeros((5, 6))).shape == (5, 3)
    with pytest.raises(FileNotFoundError):
        trainer.policy(seed=2)
    assert summary["success_rate"]["mean"] == np.mean(summary["success_rate"]["per_seed"])


def test_a_policy_says_which_task_options_it_was_trained_with(monkeypatch, tmp_path):
    (tmp_path / "sized.py").write_text(
        "from hgail_envs.point import Point\n\n\n"
        "class Sized(Point):\n"
        "    def __init__(self, radius: float = 0.05) -> None:\n"
        "        self.success_threshold = radius\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    trainer = Trainer(SMALL, task="sized:Sized", task_options=("radius=0.1",), iterations=1, out=tmp_path / "run")
    trainer.train()
    assert trainer.policy(seed=0).task_options == {"radius": 0.1}


def test_a_training_that_an_event_stops_goes_on_in_another_trainer_to_the_same_bits():
    whole = Trainer(SMALL, out=Path("whole"))
    whole.train()
    stopped = Trainer(SMALL, out=Path("stopped"))
    assert stopped.train(After(3)) is None
    done = stopped.checkpoints.saved
    assert 0 < done < 5
    assert len(table(stopped.folder)) == 2 * done
    assert not (stopped.folder / "summary.json").exists()
    resumed = Trainer(SMALL, resume=str(stopped.folder))
    summary = resumed.train()
    assert resumed.folder == stopped.folder
    assert bits(resumed.folder) == bits(whole.folder)
    of_whole = json.loads((whole.folder / "summary.json").read_text())
    for name in ("success_rate", "distance_l1", "distance_l2", "env_steps_per_seed", "diverged_seeds"):
        assert summary[name] == of_whole[name]


def test_a_training_may_be_stopped_before_it_begins():
    stop = threading.Event()
    stop.set()
    trainer = Trainer(SMALL, out=Path("run"))
    assert trainer.train(stop) is None
    assert trainer.checkpoints.saved is None
    assert Trainer(SMALL, resume="run").train() is not None


def test_a_trainer_that_is_done_writes_no_more():
    """A cell that is run once more must not begin the run anew over its own results."""
    trainer = Trainer(SMALL, out=Path("run"))
    trainer.train(After(3))
    before = table(trainer.folder), trainer.checkpoints.saved
    with pytest.raises(ValueError, match="resume"):
        trainer.train()
    assert (table(trainer.folder), trainer.checkpoints.saved) == before


def test_options_are_changed_by_name():
    options = Trainer(SMALL, seeds=1, reward="r3").options
    assert (options.seeds, options.reward, options.num_envs) == (1, "r3", 4)
    with pytest.raises(TypeError, match="colour"):
        Trainer(SMALL, colour="red")
    with pytest.raises(ValueError, match="seeds is 0; it must be at least 1"):
        Trainer(SMALL, seeds=0)
    assert not list(Path().iterdir())


def test_folders_may_be_given_as_text():
    trainer = Trainer(SMALL, out="run")
    trainer.train()
    assert Path("run/summary.json").exists()


def test_a_folder_has_one_trainer_at_a_time():
    with Trainer(SMALL, out=Path("run")) as trainer:
        trainer.open()
        with pytest.raises(ValueError, match="run is in use by another process"):
            Trainer(SMALL, resume="run").open()
        with pytest.raises(ValueError, match="run exists already"):
            Trainer(SMALL, out=Path("run")).open()
    Trainer(SMALL, resume="run").open()


def test_what_has_no_folder_yet_says_so():
    trainer = Trainer(SMALL)
    for name in ("folder", "checkpoints"):
        with pytest.raises(ValueError, match="train it"):
            getattr(trainer, name)
    with pytest.raises(ValueError, match="train it"):
        trainer.policy(0)


def test_curves_are_those_of_the_table(monkeypatch):
    drawn = []
    monkeypatch.setattr(results, "draw_curves", lambda *given: drawn.append(given))
    trainer = Trainer(SMALL, out=Path("run"))
    trainer.train()
    ((path, title, steps, success, distance),) = drawn
    assert path == Path("run/curves.png")
    assert "hgail on point: 2 seeds, 4 environments each" in title
    rows = table(Path("run"))
    np.testing.assert_array_equal(steps, [200, 800, 1400, 2000, 2600])
    for column, values in (("success_rate", success), ("distance_l1", distance)):
        expected = [[float(row[column]) for row in rows if row["round"] == str(index)] for index in range(5)]
        np.testing.assert_allclose(values, expected)


def test_curves_are_drawn_where_some_rounds_measured_nothing(tmp_path):
    values = np.array([[0.1, 0.2], [np.nan, 0.3], [np.nan, np.nan]])
    curves.draw_curves(tmp_path / "curves.png", "title", np.arange(3), values, values)
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")

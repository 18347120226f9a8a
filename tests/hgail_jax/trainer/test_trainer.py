"""The trainer as a notebook uses it: no command line, no signals."""

import csv
import dataclasses
import json
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

import hgail_envs
from hgail_envs.tasks.reference import make_reference
from hgail_jax import TD3, Checkpoints, Config, Preset, Trainer, TrainOptions, load_policy
from hgail_jax.cli import train as run
from hgail_jax.settings.defaults import DEFAULTS
from hgail_jax.trainer import results, training
from hgail_jax.trainer.folder import open_run_folder
from hgail_jax.trainer.train_options import plan
from tests.hgail_jax.trainer.stand_in import train_without_a_compiler
from tests.hgail_jax.trainer.test_checkpoint import arrays_of, saved_in
from tests.support import make_runs_tiny

SMALL = TrainOptions(task="point", seeds=2, num_envs=4, rounds=4)


@pytest.fixture(autouse=True)
def tiny(monkeypatch, tmp_path, request):
    if "whole_runs" not in request.fixturenames:
        make_runs_tiny(monkeypatch)
    if not request.node.get_closest_marker("slow"):
        train_without_a_compiler(monkeypatch)
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


@pytest.mark.slow
@pytest.mark.parametrize("learner", ["ppo", "td3"])
def test_a_run_has_no_number_that_is_none(monkeypatch, learner):
    """Of a round alone `test_train` has it."""
    few = TD3(rollouts=1, updates=2, batch=8, buffer_episodes=8)
    config = Config(num_envs=4, rounds=1, learner=few, policy_hidden=(8,), discriminator_minibatches=1)
    preset = Preset(config, TD3.hyperparameters())
    monkeypatch.setitem(DEFAULTS["point"], "td3", {"cpu": preset})
    options = dataclasses.replace(SMALL, seeds=1, rounds=1, learner=learner)
    with jax.debug_nans(True):
        assert Trainer(options, out=Path("run")).train()["diverged_seeds"] == []
        with pytest.raises(FloatingPointError):
            jax.jit(jnp.log)(-1.0)  # it does find them


def table(folder):
    with (folder / "metrics.csv").open() as file:
        return [row | {"seconds": ""} for row in csv.DictReader(file)]


def bits(folder):
    """All that a run of `SMALL` computed."""
    return table(folder), arrays_of(folder / "checkpoints" / "5").read_bytes()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A trainer that has trained, what it returned, and what it drew curves of."""
    drawn, draw = [], results.draw_curves
    with pytest.MonkeyPatch.context() as patch:
        make_runs_tiny(patch)
        train_without_a_compiler(patch)
        patch.chdir(tmp_path_factory.mktemp("notebook"))
        patch.setattr(results, "draw_curves", lambda *given: (drawn.append(given), draw(*given)))
        trainer = Trainer(SMALL)
        assert not Path("runs").exists()  # nothing is written before the training
        summary = trainer.train()
        assert trainer.folder == Path("runs/point-hgail-1")
        trainer._folder = trainer.folder.resolve()
    return trainer, summary, drawn


def test_a_run_in_a_notebook(trained):
    trainer, summary, _ = trained
    written = json.loads((trainer.folder / "summary.json").read_text())
    assert {name: written[name] for name in summary} == summary
    assert written["commit"] is None or len(written["commit"]) >= 7
    assert summary["success_rate"]["mean"] == np.mean(summary["success_rate"]["per_seed"])
    with pytest.raises(FileNotFoundError):
        trainer.policy(seed=2)


def test_each_seed_has_its_own_policy(trained):
    """That of the last checkpoint, which says itself which seed is which."""
    trainer, *_ = trained
    checkpoints = Checkpoints(trainer.folder / "checkpoints", trainer.run.identity())
    states = checkpoints.restore(jax.eval_shape(trainer.run.init)).state
    layers = [states.learner.actor_critic["policy"]["params"][f"Dense_{index}"] for index in range(3)]
    for seed in range(SMALL.seeds):
        policy = trainer.policy(seed)
        assert policy.task == "point"
        np.testing.assert_array_equal(policy.mean, states.statistics.mean[seed])
        for (weights, biases), layer in zip(policy.layers, layers, strict=True):
            np.testing.assert_array_equal(weights, layer["kernel"][seed])
            np.testing.assert_array_equal(biases, layer["bias"][seed])


def test_curves_are_those_of_the_table(trained):
    trainer, _, drawn = trained
    ((path, title, steps, success, distance),) = drawn
    assert path == Path("runs/point-hgail-1/curves.png")
    assert "hgail on point: 2 seeds, 4 environments each" in title
    rows = table(trainer.folder)
    np.testing.assert_array_equal(steps, [200, 800, 1400, 2000, 2600])
    for column, values in (("success_rate", success), ("distance_l1", distance)):
        expected = [[float(row[column]) for row in rows if row["round"] == str(index)] for index in range(5)]
        np.testing.assert_allclose(values, expected)


def test_physics_and_final_evaluation_are_ready_before_the_first_round(monkeypatch):
    ready = []

    def late(name, result=None):
        time.sleep(0.3)
        ready.append(name)
        return result

    def train_rounds(*arguments):
        assert sorted(ready) == ["physics", "trace"]
        raise RuntimeError("the rounds begin")

    monkeypatch.setattr(hgail_envs.registry.find_class("point"), "prepare", lambda self: late("physics"))
    monkeypatch.setattr(training, "trace_evaluations", lambda run: late("trace", {}))
    monkeypatch.setattr(training, "train_rounds", train_rounds)
    with pytest.raises(RuntimeError, match="the rounds begin"):
        Trainer(SMALL).train()


def test_results_name_seeds_and_task_options(tmp_path):
    run = dataclasses.replace(plan(SMALL, "cpu"), first_seed=5, task_options={"radius": 0.1})
    record = {"env_steps": 100, "success_rate": [0.5, 0.5], "distance_l1": [0.1, 0.1]}
    results.write_results(run, tmp_path, run.init(), [record])
    assert {path.name for path in (tmp_path / "policies").iterdir()} == {"seed-5.npz", "seed-6.npz"}
    assert load_policy(tmp_path / "policies" / "seed-6.npz").task_options == {"radius": 0.1}


def test_a_training_that_an_event_stops_resumes_in_another_trainer_to_the_same_bits(trained):
    whole, *_ = trained
    stopped = Trainer(SMALL, out="stopped")
    assert stopped.train(After(3)) is None
    done = saved_in(stopped.folder)[-1]
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


def test_a_training_may_be_stopped_before_it_begins_and_a_folder_is_trained_in_once():
    """A cell that is run once more must not begin the run anew over its own results."""
    stop = threading.Event()
    stop.set()
    trainer = Trainer(SMALL, out=Path("run"))
    assert trainer.train(stop) is None
    assert saved_in(trainer.folder) == []
    with pytest.raises(ValueError, match="run exists already; resume its run by --resume run"):
        trainer.train()


def test_options_are_changed_by_name():
    options = Trainer(SMALL, seeds=1, reward="r3").options
    assert (options.seeds, options.reward, options.num_envs) == (1, "r3", 4)
    changed = Trainer(SMALL, discriminator_batch=np.int64(16), solved_weight=0.5, policy_hidden=(8, 8)).run
    assert (changed.config.discriminator_batch, changed.config.policy_hidden) == (16, (8, 8))
    assert changed.hyperparameters.solved_weight == 0.5
    with pytest.raises(ValueError, match="are not numbers, True, False or lists of numbers"):
        Trainer(SMALL, discriminator_batch=object())
    with pytest.raises(ValueError, match="Config has no field 'colour'"):
        Trainer(SMALL, colour=3)
    with pytest.raises(ValueError, match="seeds is 0; it must be at least 1"):
        Trainer(SMALL, seeds=0)
    assert not list(Path().iterdir())


def test_a_folder_has_one_trainer_at_a_time():
    run = plan(SMALL, "cpu")
    with open_run_folder(run, "run", None):
        with pytest.raises(ValueError, match="run is in use by another process"):
            Trainer(SMALL, resume="run").train()
        with pytest.raises(ValueError, match="run exists already"):
            Trainer(SMALL, out="run").train()
    with open_run_folder(run, None, "run") as folder:
        assert folder.restored is None


def test_a_trainer_without_a_folder_says_so():
    trainer = Trainer(SMALL)
    with pytest.raises(ValueError, match="train it"):
        trainer.policy(0)


def test_curves_are_drawn_where_some_rounds_measured_nothing_and_nothing_overlaps(tmp_path, monkeypatch):
    drawn, save = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, *to, **how: (drawn.append(figure), save(figure, *to, **how)))
    values = np.array([[0.1, 0.2], [np.nan, 0.3], [np.nan, np.nan]])
    results.draw_curves(tmp_path / "curves.png", "title", np.arange(3), values, values)
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    (figure,) = drawn
    figure.draw_without_rendering()
    boxes = [axes.get_tightbbox() for axes in figure.axes]
    boxes += [figure.legends[0].get_window_extent(), figure._suptitle.get_window_extent()]
    for index, box in enumerate(boxes):
        assert box.overlaps(figure.bbox) and box.x0 >= 0 and box.y0 >= 0
        assert not any(box.overlaps(other) for other in boxes[:index])


def test_numpy_s_numbers_are_numbers():
    given = {"seeds": np.int64(1), "first_seed": np.int32(0), "num_envs": np.int64(8), "bc_weight": np.float32(0.5)}
    trainer = Trainer(task="point", checkpoint_every=np.int64(1), evaluation_episodes=np.uint8(8), **given)
    json.dumps([trainer.run.options, trainer.run.identity()])
    assert (trainer.options.num_envs, trainer.options.bc_weight) == (8, 0.5)


def test_final_evaluations_have_as_many_episodes_as_asked_for(monkeypatch):
    """Of a randomised task as trained, and without randomisation."""
    traced = []
    monkeypatch.setattr(training, "trace_evaluation", lambda env, *sizes: traced.append((env, *sizes)))
    planned = plan(TrainOptions(task="reach", seeds=1, num_envs=2, randomize="mild", evaluation_episodes=9), "cpu")
    training.trace_evaluations(planned)
    assert [(env.randomization, episodes) for env, _, _, episodes, _ in traced] == [
        (planned.env.randomization, 9),
        (planned.env.randomization.nominal(), 9),
    ]


@pytest.fixture
def whole_runs():
    """Asks for runs of the task's own sizes."""


@pytest.mark.slow
def test_two_seeds_learn_reach_and_run_in_the_reference(tmp_path, whole_runs):
    run.main(["--seeds", "2", "--out", str(tmp_path / "run")])
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert min(summary["success_rate"]["per_seed"]) >= 0.98
    env = make_reference("FetchReach-v4")
    for path in (tmp_path / "run" / "policies").iterdir():
        policy, successes = load_policy(path), []
        for episode in range(100):
            seen, _ = env.reset(seed=episode)
            for _ in range(50):
                inputs = np.concatenate([seen["observation"][[0, 1, 2, 5, 6, 7]], seen["desired_goal"]])
                seen, *_ = env.step(policy(inputs).astype(np.float32))
            successes.append(np.linalg.norm(seen["achieved_goal"] - seen["desired_goal"]) <= 0.05)
        assert np.mean(successes) >= 0.97

"""Learners side by side."""

import json
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from experiments import other_trainers
from experiments.bench import __main__ as bench
from experiments.bench import learners, whole_runs
from experiments.bench.figures import draw_learners
from hgail_jax.io.files import write_csv
from tests.support import ELSEWHERE, HERE


@pytest.mark.parametrize(("limit", "count"), [(900.0, 3), (15.0, 2)])
def test_a_seed_ends_with_two_successes_or_at_its_time(monkeypatch, limit, count):
    def train(task, num_envs, seed, tested):
        for index, success in enumerate((0.99, 0.5, 0.98, 1.0, 0.0)[1 if limit == 900.0 else 0 :]):
            if tested(100 * index, 10.0 * (index + 1), success):
                return
        pytest.fail("nothing ended it")

    monkeypatch.setattr(learners, "train_contrastive", train)
    rows = list(learners.contrastive_rows("reach", False, limit))
    assert [row["seed"] for row in rows] == [0, 1, 2, 3]
    assert all(len(row["success"]) == len(row["env_steps"]) == len(row["train_seconds"]) == count for row in rows)


MADE = {"commit": "c", "device": {}, "cpu_cores": 2, "versions": {}}


def fake_runs(monkeypatch, planned=None, tests=((100, 1.5, "0.25"), (200, 3.0, ""), (300, 4.5, "0.75"))):
    """Makes runs that took 10 seconds to compile; returns the list of their arguments and time limits."""
    asked = []

    def run(folder, arguments, programs, time_limit):
        asked.append((arguments, time_limit))
        folder.mkdir()
        (folder / "config.json").write_text(json.dumps(MADE))
        os.utime(folder / "config.json", (1000.0, 1000.0))
        rows = [
            {"seed": seed, "success_rate": success, "env_steps": steps, "seconds": seconds}
            for steps, seconds, success in tests
            for seed in range(4)
        ]
        write_csv(folder / "metrics.csv", rows)
        last = 1010.0 + (tests[-1][1] if tests else 0.0)
        os.utime(folder / "metrics.csv", (last, last))

    monkeypatch.setattr(learners, "run_training", run)
    settings = planned or (lambda arguments: [{"method": words[5], "its": words} for words in arguments])
    monkeypatch.setattr(learners, "planned", settings)
    return asked


def test_a_learner_s_rows_are_its_tests(monkeypatch):
    asked = fake_runs(monkeypatch)
    rows, made_by = zip(*learners.own_rows("push", ["gcsl"], False, 60.0), strict=True)
    assert asked == [(["--task", "push", "--seeds", "4", "--method", "gcsl"], 60.0)]
    assert [(made["commit"], made["cpu_cores"]) for made in made_by] == [("c", 2)] * 4
    assert [row.pop("seed") for row in rows] == [0, 1, 2, 3]
    measured = SimpleNamespace(**rows[3])
    assert (measured.task, measured.what) == ("push", "GCSL")
    assert (measured.env_steps, measured.train_seconds, measured.success) == ([100, 300], [11.5, 14.5], [0.25, 0.75])


def test_a_learner_that_is_another_one_on_the_task_is_left_out(monkeypatch, capsys):
    def planned(arguments):
        return [{"method": words[5], "reward": 1.0 if "ppo" not in words else 0.0} for words in arguments]

    asked = fake_runs(monkeypatch, planned)
    rows = [row for row, _ in learners.own_rows("reach", ["hgail", "her", "ppo"], False, 60.0)]
    assert list(dict.fromkeys(row["what"] for row in rows)) == ["HGAIL, TD3", "PPO"]
    assert len(asked) == 2
    assert capsys.readouterr().out == "left out: HER, TD3 (on reach it is HGAIL, TD3)\n"


def test_a_learner_that_was_not_tested_in_its_time_is_left_out(monkeypatch, capsys):
    fake_runs(monkeypatch, tests=())
    assert list(learners.own_rows("push", ["ppo"], False, 2.0)) == []
    assert capsys.readouterr().out == "left out: PPO (not tested within 2 s)\n"


def test_settings_tell_which_learners_differ():
    """Reach's default reward is the goal test alone; push has none on a GPU, and half of it on a CPU."""
    names = [
        ("reach", "hgail"),
        ("reach", "her"),
        ("push", "hgail"),
        ("push", "hgail-no-reward"),
        ("push", "hgail-ppo"),
    ]
    found = whole_runs.planned([["--task", task, *learners.OWN[name].arguments] for task, name in names])
    assert [settings.pop("method") for settings in found] == ["hgail", "her", "hgail", "hgail", "hgail"]
    assert found[0] == found[1]
    assert len({json.dumps(settings) for settings in found}) == 4
    assert [settings["hyperparameters"]["environment_reward"] for settings in found] == [1.0, 1.0, 0.5, 0.0, 0.0]
    assert [settings["config"]["learner"]["name"] for settings in found] == ["td3"] * 4 + ["ppo"]


_ENDS_WHEN_TOLD = """
import pathlib, signal, sys, time
folder, told = pathlib.Path(sys.argv[-1]), []
signal.signal(signal.SIGTERM, lambda *_: told.append(True))
(folder / "began").touch()
while not told:
    time.sleep(0.01)
(folder / "ended").touch()
sys.exit(3)
"""


def test_a_run_is_told_to_stop_and_waited_for_when_its_time_is_over(monkeypatch, tmp_path):
    monkeypatch.setattr(whole_runs, "_TRAIN", (sys.executable, "-c", _ENDS_WHEN_TOLD))
    whole_runs.run_training(tmp_path, [], tmp_path, time_limit=2.0)
    assert (tmp_path / "began").exists() and (tmp_path / "ended").exists()


def test_a_run_that_fails_by_itself_is_an_error(monkeypatch, tmp_path):
    monkeypatch.setattr(whole_runs, "_TRAIN", (sys.executable, "-c", "import sys; sys.exit(2)"))
    with pytest.raises(subprocess.CalledProcessError) as failure:
        whole_runs.run_training(tmp_path, [], tmp_path, time_limit=60.0)
    assert failure.value.returncode == 2


def test_stable_baselines_row_has_its_tests_and_the_seconds_between_them(monkeypatch):
    now, asked = [0.0], []

    def make_test(task, substeps):
        def test(policy):
            now[0] += 100.0
            return policy

        return asked.append((task, substeps)) or test

    def train(tested, most_steps, task, substeps):
        asked.append((task, substeps))
        for index, success in enumerate((0.5, 0.99, 1.0, 1.0)):
            now[0] += 10.0
            if tested(1000 * (index + 1), success):
                return

    monkeypatch.setitem(sys.modules, "stable_baselines3", SimpleNamespace(__version__="9"))
    monkeypatch.setattr(other_trainers, "make_test", make_test)
    monkeypatch.setattr(other_trainers, "sb3_sac_her", train)
    monkeypatch.setattr(learners.time, "perf_counter", lambda: now[0])
    (row,) = learners.sac_her_rows("push", False, 900.0)
    assert asked == [("push", 8)] * 2
    assert row == {
        "task": "push",
        "what": "stable-baselines3 9 SAC and HER",
        "seed": 0,
        "env_steps": [1000, 2000, 3000],
        "train_seconds": [10.0, 20.0, 30.0],
        "success": [0.5, 0.99, 1.0],
    }
    (row,) = learners.sac_her_rows("push", False, 15.0)
    assert row["env_steps"] == [1000, 2000]


def test_settings_are_read_after_what_an_engine_prints(monkeypatch):
    monkeypatch.setattr(whole_runs, "_PLAN", f"print('Warp 1.14.0 initialized:')\n{whole_runs._PLAN}")
    (settings,) = whole_runs.planned([["--task", "point", "--method", "ppo"]])
    assert settings["method"] == "ppo"


def test_own_learners_are_measured_without_gymnasium():
    code = "import sys; sys.modules['gymnasium'] = None; import experiments.bench.__main__"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_stable_baselines_is_left_to_the_cpu(monkeypatch):
    monkeypatch.setattr(learners, "platform_name", lambda: "gpu")
    with pytest.raises(ImportError, match="on a CPU alone"):
        next(learners.sac_her_rows("push", False, 900.0))


def test_only_the_named_learners_are_trained(monkeypatch, capsys):
    asked = []

    def contrastive_rows(task, quick, time_limit):
        asked.append((task, time_limit))
        raise ImportError("No module named 'jaxgcrl'")
        yield

    monkeypatch.setattr(bench, "own_rows", lambda *arguments: asked.append(arguments) or iter([({"what": "HER"}, {})]))
    monkeypatch.setattr(bench, "contrastive_rows", contrastive_rows)
    options = bench.Options(section=("learners",), task=("push",), learner=("crl", "her"), time_limit=60.0)
    assert [row for row, _ in bench.measure(options)] == [{"section": "learners", "what": "HER"}]
    assert asked == [("push", ["her"], False, 60.0), ("push", 60.0)]
    assert capsys.readouterr().out == "left out: crl (No module named 'jaxgcrl')\n"


def test_the_picture_shows_what_ran_on_the_same_device(tmp_path, monkeypatch):
    def row(what, seed):
        curve = {"env_steps": [100, 200], "train_seconds": [1.0, 2.0], "success": [0.0, 1.0]}
        return {"section": "learners", "task": "reach", "what": what, "seed": seed, **curve}

    drawn = []
    monkeypatch.setattr(bench, "draw_learners", lambda rows, path: drawn.append((rows, path)))
    made = [(row("HGAIL", 0), ELSEWHERE), (row("HGAIL", 0), HERE), (row("HGAIL", 1), HERE), (row("other", 0), HERE)]
    monkeypatch.setattr(bench, "measure", lambda options: iter(made))
    bench.main(["--out", str(tmp_path / "bench.json")])
    ((rows, path),) = drawn
    assert [(row["what"], row["seed"]) for row in rows] == [("HGAIL", 0), ("HGAIL", 1), ("other", 0)]
    assert path == tmp_path / "learners-reach-cpu.png"


def test_each_learner_has_a_colour_of_its_own(tmp_path):
    curve = {
        "env_steps": [100, 200],
        "train_seconds": [1.0, 2.0],
        "success": [0.0, 1.0],
        "made_by": HERE | {"cpu_cores": 2},
    }
    rows = [{"task": "reach", "what": what, "seed": seed} | curve for what in ("HGAIL", "other") for seed in (0, 1)]
    learners_figure = tmp_path / "learners.png"
    draw_learners(rows, learners_figure)
    colours = {tuple(colour) for colour in np.asarray(Image.open(learners_figure).convert("RGB")).reshape(-1, 3)}
    strong = {colour for colour in colours if max(colour) - min(colour) > 100}
    assert any(blue > red for red, _, blue in strong) and any(red > blue for red, _, blue in strong)

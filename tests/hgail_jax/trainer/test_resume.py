"""Runs that are stopped, killed or broken, and resume as if nothing had happened."""

import csv
import hashlib
import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from hgail_envs.scenes import assets_directory
from hgail_jax import METHODS
from hgail_jax.cli import demos
from hgail_jax.cli import train as run
from hgail_jax.trainer import loop
from hgail_jax.trainer.checkpoint import AnotherRunError, Checkpoints, as_json, refuse_another_run
from hgail_jax.trainer.folder import sole_user
from hgail_jax.trainer.train_options import TrainOptions, plan
from tests.hgail_jax.trainer.test_checkpoint import arrays_of, record_of, saved_in
from tests.support import SOURCES, TINY_RUN, compile_once, make_runs_tiny, refused, small_files_only

ROUNDS = 4  # and the pre-training


@pytest.fixture(autouse=True)
def tiny(monkeypatch, tmp_path):
    """Makes every run tiny, in a folder of its own."""
    make_runs_tiny(monkeypatch)
    compile_once(monkeypatch)
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def demonstrations(tmp_path_factory):
    path = tmp_path_factory.mktemp("demonstrations") / "point.npz"
    demos.main(["--task", "point", "--episodes", "5", "--out", str(path)])
    return path


def start(*arguments, method="hgail"):
    size = ["--seeds", "2", "--num-envs", "4", "--rounds", str(ROUNDS)]
    run.main(["--task", "point", "--method", method, *size, *arguments])


def fail_in_round(monkeypatch, index, failure):
    """Lets a round's step call `failure`, once the round is computed, instead of returning."""
    compile_step = loop.compile_train_step

    def compile_failing(*arguments):
        step, calls = compile_step(*arguments), iter(range(1000))

        def failing(states, phases):
            result = step(states, phases)
            return failure(result) if next(calls) == index else result

        return failing

    monkeypatch.setattr(loop, "compile_train_step", compile_failing)


def crash(result):
    raise RuntimeError("crash")


def read_metrics(folder):
    with (folder / "metrics.csv").open() as file:
        return [row | {"seconds": ""} for row in csv.DictReader(file)]


def outcome(folder):
    """All that a run computed, to the bit."""
    summary = json.loads((folder / "summary.json").read_text())
    for varying in ("wall_seconds", "env_steps_per_second", "command"):
        del summary[varying]
    policies = {}
    for path in sorted((folder / "policies").iterdir()):
        with np.load(path) as file:
            policies[path.name] = {name: file[name].tobytes() for name in file.files}
    arrays = arrays_of(folder / "checkpoints" / str(ROUNDS + 1)).read_bytes()
    return summary, policies, read_metrics(folder), hashlib.sha256(arrays).hexdigest()


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Returns the folder of a method's run that nothing interrupted."""
    folders = {}

    def of(method, *arguments):
        if method not in folders:
            folder = tmp_path_factory.mktemp("whole") / "run"
            start("--out", str(folder), *arguments, method=method)
            folders[method] = folder
        return folders[method]

    return of


@pytest.fixture
def whole(folders):
    """Returns the outcome of such a run."""
    return lambda *arguments: outcome(folders(*arguments))


@pytest.fixture
def complete(folders, tmp_path):
    """A complete run in the folder `run`; ask for it before `capsys`, which would hear its training."""
    return shutil.copytree(folders("hgail"), tmp_path / "run")


@pytest.mark.parametrize(
    "method", [pytest.param(name, marks=() if name == "hgail" else pytest.mark.slow) for name in METHODS]
)
def test_a_run_that_was_interrupted_ends_as_one_that_was_not(tmp_path, monkeypatch, whole, demonstrations, method):
    given = ["--demos", str(demonstrations)] if method == "gail-demo" else []
    expected = whole(method, *given)
    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="crash"):
        fail_in_round(patch, 3, crash)
        start("--resume", "auto", *given, method=method)  # which begins a run where there is none
    folder = tmp_path / "runs" / f"point-{method}-1"
    assert len(read_metrics(folder)) == 3 * 2
    start("--resume", "auto", *given, method=method)
    assert outcome(folder) == expected
    assert [path.name for path in (tmp_path / "runs").iterdir()] == [folder.name]


def test_a_round_that_was_measured_but_not_saved_is_in_the_table_once(tmp_path, monkeypatch, whole):
    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="crash"):
        fail_in_round(patch, 4, crash)
        start("--out", "run", "--checkpoint-every", "3")
    assert len(read_metrics(tmp_path / "run")) == 4 * 2
    with (tmp_path / "run" / "metrics.csv").open("a") as file:
        file.write("0,4,half a ro")
    assert saved_in(Path("run")) == [3]
    start("--resume", "run", "--checkpoint-every", "2")
    assert outcome(tmp_path / "run") == whole("hgail")
    assert saved_in(Path("run")) == [3, 4, 5]


def test_a_run_stopped_by_a_signal_saves_and_resumes(tmp_path, monkeypatch, capsys, whole):
    def terminate(result):
        os.kill(os.getpid(), signal.SIGTERM)
        while "SIGTERM" not in sys.stderr.getvalue():  # for the main thread
            time.sleep(0.01)
        return result

    handlers = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)]
    with monkeypatch.context() as patch:
        fail_in_round(patch, 1, terminate)
        start("--out", "run", "--checkpoint-every", "10")  # returns: exit code 0
    shown = capsys.readouterr()
    assert "SIGTERM: stopping after this round" in shown.err
    said, _, command = shown.out.splitlines()[-1].partition("; resume with: ")
    assert said == "stopped after round 1 of 4"
    assert saved_in(Path("run")) == [2]
    assert not Path("run/summary.json").exists()
    assert handlers == [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)]
    program, name, *words = shlex.split(command)
    assert (Path(program).name, name) == ("hgail", "train")
    run.main(words)
    assert "run resumes after round 1 of 4" in capsys.readouterr().out
    assert outcome(tmp_path / "run") == whole("hgail")


def test_a_complete_run_writes_its_results_again_with_the_times_of_the_whole_run(
    tmp_path, monkeypatch, whole, complete, capsys
):
    for name in ("summary.json", "metrics.csv", "curves.png", "policies/seed-1.npz"):
        (tmp_path / "run" / name).unlink()
    config, restore = (tmp_path / "run" / "config.json").read_bytes(), Checkpoints.restore

    def restore_of_a_long_run(*arguments):
        checkpoint = restore(*arguments)
        return checkpoint._replace(record=checkpoint.record | {"seconds": 5000.0})

    monkeypatch.setattr(Checkpoints, "restore", restore_of_a_long_run)
    capsys.readouterr()
    start("--resume", "run")
    shown = capsys.readouterr()
    assert "run has all its rounds; its results are written" in shown.out
    assert "round" not in shown.err
    assert outcome(tmp_path / "run") == whole("hgail")
    assert (tmp_path / "run" / "curves.png").exists()
    assert (tmp_path / "run" / "config.json").read_bytes() == config
    summary = json.loads((complete / "summary.json").read_text())
    seconds = summary["wall_seconds"]
    assert seconds["train"] == 5000.0
    assert seconds["total"] > sum(seconds[name] for name in ("compile", "train", "evaluation"))
    assert summary["env_steps_per_second"] == summary["env_steps_per_seed"] * summary["seeds"] / 5000.0


@pytest.mark.parametrize("named", [True, False])
def test_a_finished_run_is_left_as_it_is(tmp_path, complete, capsys, named):
    """A command with --resume auto may be repeated until it does nothing, as in a script of a cluster."""
    folder = "run" if named else "runs/point-hgail-1"
    if not named:
        complete = shutil.copytree(complete, tmp_path / folder)

    def files():
        return {
            path: (path.read_bytes(), path.stat().st_mtime_ns) for path in complete.rglob("[!.]*") if path.is_file()
        }

    before = files()
    start("--resume", "run" if named else "auto")
    shown = capsys.readouterr().out
    assert shown.startswith(f"{folder} is complete; without --resume another run begins\n")
    assert f" -> {folder}\n" not in shown.partition("success")[0], "nothing is trained"
    total = json.loads((complete / "summary.json").read_text())["wall_seconds"]["total"]
    assert f"total {total:.1f} s -> {folder}" in shown
    assert files() == before
    assert named or [path.name for path in (tmp_path / "runs").iterdir()] == ["point-hgail-1"]


def test_a_damaged_checkpoint_costs_a_round(tmp_path, monkeypatch, capsys, whole):
    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="crash"):
        fail_in_round(patch, 3, crash)
        start("--out", "run")
    os.truncate(record_of(Path("run/checkpoints/3")), 100)
    start("--resume", "run")
    shown = capsys.readouterr()
    assert f"checkpoint 3 in {tmp_path}/run/checkpoints is damaged" in shown.err
    assert "run resumes after round 1 of 4" in shown.out
    assert outcome(tmp_path / "run") == whole("hgail")


def test_what_was_killed_before_its_first_checkpoint_begins_again(tmp_path, whole, complete, capsys):
    shutil.rmtree("run/checkpoints")
    Path("run/.17.partial.metrics.csv").touch()
    start("--resume", "run")
    assert "run has no checkpoint yet and begins with round 0" in capsys.readouterr().out
    assert outcome(tmp_path / "run") == whole("hgail")
    assert not Path("run/.17.partial.metrics.csv").exists()
    Path("runs/point-hgail-1").mkdir(parents=True)  # killed before its first file
    start("--resume", "auto")
    assert outcome(tmp_path / "runs" / "point-hgail-1") == whole("hgail")


def test_a_folder_is_trained_in_by_one_process_at_a_time(complete, capsys):
    with sole_user(complete), pytest.raises(SystemExit) as exit_info:
        start("--resume", "run")
    assert exit_info.value.code == 2
    assert capsys.readouterr().err.splitlines()[-1] == "hgail train: run is in use by another process"
    start("--resume", "run")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--num-envs", "8"], "config.num_envs is 4 there and 8 here"),
        (["--rounds", "8"], "config.rounds is 4 there and 8 here"),
        (["--seeds", "3"], "seeds is 2 there and 3 here"),
        (["--first-seed", "1"], "first_seed is 0 there and 1 here"),
        (["--method", "ppo"], "method is hgail there and ppo here"),
        (["--task", "reach"], "task is point there and reach here"),
        (["--reward", "r3"], "hyperparameters.reward is 0 there and 2 here"),
        (["--no-pretrain"], "config.learner.pretrain is True there and False here"),
    ],
)
def test_another_run_is_refused_in_one_line(tmp_path, complete, capsys, arguments, message):
    for checkpoints in ("there", "missing"):
        if checkpoints == "missing":
            shutil.rmtree("run/checkpoints")
        before = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*")}
        capsys.readouterr()
        refused(lambda words: start(*words), ["--resume", "run", *arguments], message, capsys)
        assert {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*")} == before


@pytest.mark.parametrize("content", ["", "{}", "[" * 100_000, '{"task": []}', "\x00"])
def test_a_folder_that_is_none_of_a_run_is_refused(tmp_path, capsys, content):
    Path("run").mkdir()
    Path("run/config.json").write_text(content)
    refused(lambda words: start(*words), ["--resume", "run"], "run", capsys)
    assert [path.name for path in Path("run").iterdir()] == ["config.json"]


def diverge(*fractions):
    """Has a round measure these fractions of updates that were not finite, by seed."""

    def change(result):
        states, metrics = result
        return states, metrics.replace(diverged=np.array(fractions, np.float32))

    return change


def test_divergence_of_all_seeds_stops_the_run_at_the_last_good_checkpoint(tmp_path, monkeypatch, capsys, whole):
    with monkeypatch.context() as patch, pytest.raises(SystemExit) as exit_info:
        fail_in_round(patch, 3, diverge(0.5, 1.0))
        start("--out", "run")
    assert exit_info.value.code == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == (
        "hgail train: the training stops: no seed's update is finite in round 3;"
        f" the last good checkpoint: {tmp_path}/run/checkpoints/3"
    )
    assert len(read_metrics(tmp_path / "run")) == 3 * 2
    start("--resume", "run")
    assert outcome(tmp_path / "run") == whole("hgail")


def test_divergence_of_one_seed_is_counted_and_shown(tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        fail_in_round(patch, 3, diverge(0.0, 0.5))
        start("--out", "run")
    assert capsys.readouterr().err.splitlines()[-1] == "updates that were not finite were undone: seed 1"
    rows = read_metrics(tmp_path / "run")
    assert [float(row["diverged_rate"]) for row in rows if row["round"] == "3"] == [0.0, 0.5]
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["diverged_seeds"] == ["seed 1"]


def test_an_overflow_of_contacts_stops_the_run(monkeypatch, capsys):
    def overflow(result):
        states, metrics = result
        return states, metrics.replace(overflow=np.array([0.0, 0.01], np.float32))

    fail_in_round(monkeypatch, 2, overflow)
    with pytest.raises(SystemExit) as exit_info:
        start("--out", "run")
    assert exit_info.value.code == 1
    assert "the simulation ran out of room for contacts in round 2; the last good" in capsys.readouterr().err


def test_parameters_that_diverge_unmeasured_are_not_saved(tmp_path, monkeypatch, capsys):
    def diverge(result):
        states, metrics = result
        return states.replace(discriminator=jax.tree.map(lambda leaf: leaf * np.nan, states.discriminator)), metrics

    fail_in_round(monkeypatch, 2, diverge)
    with pytest.raises(SystemExit) as exit_info:
        start("--out", "run")
    assert exit_info.value.code == 1
    assert "discriminator.params.Dense_0.bias is not finite" in capsys.readouterr().err
    assert saved_in(Path("run")) == [1, 2]


def test_a_disk_that_fills_up_stops_the_run_with_nothing_half_written(tmp_path, monkeypatch, capsys, whole):
    with monkeypatch.context() as patch, pytest.raises(SystemExit) as exit_info:
        fail_in_round(patch, 3, lambda result: (full.__enter__(), result)[1])
        full = small_files_only(2_000)
        try:
            start("--out", "run")
        finally:
            full.__exit__(None, None, None)
    assert exit_info.value.code == 1
    assert "hgail train: the run stops: " in capsys.readouterr().err
    left = {str(path.relative_to("run")) for path in Path("run").rglob("*") if path.is_file()}
    assert {name for name in left if not name.startswith("checkpoints/")} == {".lock", "config.json", "metrics.csv"}
    assert latest_checkpoint(Path("run")) in (2, 3)  # the third may be on its way when the disk is full
    start("--resume", "run")
    assert outcome(tmp_path / "run") == whole("hgail")
    assert len(saved_in(Path("run"))) + len(["history.jsonl"]) == len(os.listdir("run/checkpoints"))


def latest_checkpoint(folder):
    return max(saved_in(folder), default=0)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["point", "reach"])
def test_twenty_kills_at_random_moments_lose_nothing(tmp_path, task):
    """Each kill comes at a random moment after the start, most of them while rounds run and checkpoints are written.

    In reach C MuJoCo's threads are among what is killed.
    """
    rounds, moments = 160, random.Random(0)
    size = ["--task", task, "--seeds", "2", "--num-envs", "2", "--rounds", str(rounds)]
    command = [sys.executable, "-c", TINY_RUN, *size, *(["--impl", "c"] if task == "reach" else [])]

    def launch(*arguments):
        with (tmp_path / "output").open("w") as output:
            environment = os.environ | {"PYTHONPATH": SOURCES}
            return subprocess.Popen([*command, *arguments], cwd=tmp_path, env=environment, stdout=output, stderr=output)

    def finish(*arguments):
        assert launch(*arguments).wait() == 0, (tmp_path / "output").read_text()

    finish("--out", "whole")
    folder, done = tmp_path / "runs" / f"{task}-hgail-1", []
    for kill in range(20):
        process = launch("--resume", "auto")
        before = latest_checkpoint(folder)
        if kill % 5:  # the others come while the program starts
            wanted = before + moments.randint(1, 8)
            while latest_checkpoint(folder) < wanted and process.poll() is None:
                time.sleep(0.002)
        time.sleep(moments.uniform(0.0, 0.2 if kill % 5 else 3.0))
        process.kill()
        assert process.wait() == -signal.SIGKILL, (tmp_path / "output").read_text()
        done.append(latest_checkpoint(folder))
        # A checkpoint is written while the next round runs: two rounds may be measured and not saved.
        assert done[-1] >= before
        if done[-1]:
            assert done[-1] <= len(read_metrics(folder)) // 2 <= done[-1] + 2
    assert len(set(done)) > 10
    assert done[-1] <= rounds
    finish("--resume", "auto")
    assert "is damaged" not in (tmp_path / "output").read_text()
    assert read_metrics(folder) == read_metrics(tmp_path / "whole")
    last = [arrays_of(run / "checkpoints" / str(rounds + 1)) for run in (folder, tmp_path / "whole")]
    assert last[0].read_bytes() == last[1].read_bytes()
    assert not list(folder.rglob("*.partial")) + list(folder.rglob("*tmp*"))


@pytest.mark.slow
def test_a_run_on_an_arm_whose_description_was_changed_is_another_one(monkeypatch):
    pytest.importorskip("gymnasium_robotics")  # it has the model
    description = Path("arm.toml")
    text = (assets_directory() / "robots" / "franka.toml").read_text()

    def identity():
        return plan(TrainOptions(task="reach", robot=str(description), seeds=1), "cpu").identity()

    description.write_text(text)
    first = as_json(identity())
    refuse_another_run("folder", first, identity())
    with monkeypatch.context() as changed:  # the MJCF that it names
        changed.setattr("hgail_jax.trainer.run.digest", lambda model: "another")
        with pytest.raises(AnotherRunError, match="description and model of the robot is"):
            refuse_another_run("folder", first, identity())
    description.write_text(text.replace("2.61, 2.61, 2.61", "2.0, 2.0, 2.0"))
    with pytest.raises(AnotherRunError, match=r"description and model of the robot is \w{8} there"):
        refuse_another_run("folder", first, identity())

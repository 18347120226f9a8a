"""The speed's measurements: command line and, slowly, its sections; its file; rates; calls timed in turn."""

import itertools
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.bench import __main__ as bench
from experiments.bench import pictures, results, whole_runs
from experiments.bench import workload as timing
from experiments.bench.results import Results, table
from experiments.bench.speed import Stepping
from experiments.bench.training import ppo_fractions, td3_fractions
from experiments.bench.whole_runs import first_success, train
from experiments.bench.workload import Workload
from hgail_jax.io.provenance import provenance
from tests.support import ELSEWHERE, HERE

ROOT = Path(results.__file__).resolve().parents[2]
BENCH = [sys.executable, "-m", "experiments.bench"]


def refusal(capture, arguments):
    """The one line that `arguments` are refused with."""
    with pytest.raises(SystemExit) as stop:
        bench.main(arguments)
    assert stop.value.code == 2
    (line,) = capture.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize(
    ("options", "path"),
    [
        ([], "runs/bench/bench.json"),
        (["--quick"], "runs/quick/bench.json"),
        (["--out", "elsewhere/bench.json"], "elsewhere/bench.json"),
    ],
)
def test_rows_go_to_a_file_under_runs_unless_another_is_named(tmp_path, monkeypatch, capsys, options, path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bench, "measure", lambda options: iter([({"section": "speed", "num_envs": 4}, HERE)]))
    bench.main(options)
    assert [file.relative_to(tmp_path) for file in tmp_path.rglob("*") if file.is_file()] == [Path(path)]
    (row,) = json.loads(Path(path).read_text())["rows"]
    assert (row["num_envs"], row.get("quick")) == (4, True if options == ["--quick"] else None)
    assert capsys.readouterr().out.count("num_envs") == 1  # a single row is printed once


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--impl", "ode"], "bench: impl is 'ode'; choose from auto, "),
        (["--seeds", "8", "1"], "bench: seeds is 8 1; the first must be 1"),
        (["--num-envs", "0"], "bench: num_envs is 0; it must be at least 1"),
        (["--task", "reach", "point"], "bench: task is 'point'; choose from "),
        (["--section", "everything"], "bench: invalid choice 'everything' for argument '--section'"),
        (["--num-envs"], "bench: --num-envs names nothing"),
        (["--section", "pictures", "--look", "dark"], "bench: look is 'dark'; choose from plain, "),
        (["--section", "pictures", "--picture-size", "0"], "bench: picture_size is 0; it must be at least 1"),
        (["--section", "physics", "--run=--seeds=1"], "bench: --run is for --section compile and time-to-success"),
    ],
)
def test_mistakes_are_refused_in_one_line(tmp_path, monkeypatch, capsys, options, reason):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bench, "measure", lambda options: pytest.fail("it measured"))
    assert refusal(capsys, options).startswith(reason)
    assert not any(tmp_path.iterdir())


def test_a_file_of_something_else_is_refused_in_one_line(tmp_path, capsys):
    path = tmp_path / "bench.json"
    path.write_text("[1, 2]")
    assert refusal(capsys, ["--section", "physics", "--out", str(path)]).startswith(f"bench: {path} is no file of")


def test_a_run_that_refuses_its_options_says_so_alone(tmp_path, capfd):
    path = tmp_path / "bench.json"
    line = refusal(capfd, ["--section", "compile", "--run=--seeds=0", "--out", str(path)])
    assert line.startswith("hgail train: seeds is 0")
    assert not path.exists()


def test_what_made_a_row_has_the_commit_of_the_checkout():
    found = subprocess.run(["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True, text=True)
    commit = provenance()["commit"]
    assert commit is None if found.returncode else found.stdout.startswith(commit.removesuffix("-dirty"))


def test_pictures_a_second_are_those_of_all_steps_environments_and_cameras(monkeypatch):
    """Of 5 steps of 3 environments with 2 cameras, in 2 s alone and in 4 s with the physics."""
    monkeypatch.setattr(
        pictures, "Pictures", lambda env, **made: SimpleNamespace(renderer="warp", cameras=("front", "side"), **made)
    )
    monkeypatch.setattr(pictures, "CameraEnv", lambda env, shown: SimpleNamespace(reset=lambda key: key))
    monkeypatch.setattr(pictures, "compile_timed", lambda function, *arguments: (function, 0.0))
    taken = {"pictures": 2.0, "pictures_with_physics": 4.0}
    monkeypatch.setattr(pictures, "seconds_side_by_side", lambda calls: {name: taken[name] for name in calls})
    workload = SimpleNamespace(
        task="push", env=SimpleNamespace(impl="warp"), num_envs=3, substeps=8, actions=lambda: np.zeros((5, 3, 4))
    )
    rows = list(pictures.measure_pictures(workload, (16, 32), "plain"))
    assert [(row["kind"], row["size"]) for row in rows] == list(itertools.product(("colour", "depth"), (16, 32)))
    assert {row["pictures_per_second"] for row in rows} == {15.0}
    assert {row["pictures_with_physics_per_second"] for row in rows} == {7.5}


def test_reading_options_starts_no_backend(forks):
    """Runs in processes of their own would find the GPU's memory taken."""
    program = (
        "from experiments.bench import __main__ as bench; from jax._src import xla_bridge\n"
        "bench.measure_compilation = lambda *arguments: print(xla_bridge.backends_are_initialized()) or ({}, {})\n"
        "next(bench.measure(bench.Options(section=('compile',))))"
    )
    assert forks.run(program).stdout.split() == ["False"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "section",
    [
        ["shares"],
        ["shares", "--task", "push"],
        ["seeds"],
        ["seeds", "--task", "push"],
        ["devices"],
        ["devices", "--task", "push"],
        ["pictures", "--picture-size", "16"],
        ["compile"],
        ["time-to-success"],
    ],
)
def test_every_section_runs(tmp_path, section):
    path = tmp_path / "bench.json"
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"
    flags += " --xla_force_host_platform_device_count=2" if section[0] == "devices" else ""
    command = [*BENCH, "--quick", "--section", *section, "--out", path]
    subprocess.run(command, check=True, cwd=ROOT, env=os.environ | {"XLA_FLAGS": flags}, timeout=900)
    found = json.loads(path.read_text())["rows"]
    assert found
    assert all(row["made_by"]["command"] and row["quick"] for row in found)


def test_a_folder_that_cannot_be_written_is_noticed_before_anything_is_measured(tmp_path, monkeypatch, capsys):
    def refuse(*arguments, **options):
        raise PermissionError(13, "Permission denied", str(tmp_path))

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)  # root may write anywhere, so no mode of a folder would do
    monkeypatch.setattr(bench, "measure", lambda options: pytest.fail("it measured"))
    line = refusal(capsys, ["--section", "physics", "--out", str(tmp_path / "bench.json")])
    assert line == f"bench: {tmp_path}: Permission denied"


def rows(path):
    return [(row["num_envs"], row["speed"]) for row in json.loads(path.read_text())["rows"]]


def test_a_row_takes_the_place_of_its_like_and_of_no_other(tmp_path):
    path = tmp_path / "bench.json"
    results = Results(path)
    results.add({"section": "speed", "num_envs": 1, "speed": 10.0}, HERE)
    results.add({"section": "speed", "num_envs": 2, "speed": 20.0}, HERE)
    results.add({"section": "speed", "num_envs": 1, "speed": 30.0}, ELSEWHERE)
    again = Results(path)
    again.add({"section": "speed", "num_envs": 1, "speed": 40.0}, HERE)
    assert rows(path) == [(2, 20.0), (1, 30.0), (1, 40.0)]
    assert [row["speed"] for row in again.added] == [40.0]
    again.add({"section": "speed", "num_envs": 2, "options": "--seeds=1", "speed": 50.0}, HERE)
    assert rows(path) == [(2, 20.0), (1, 30.0), (1, 40.0), (2, 50.0)]


def test_a_file_of_something_else_is_refused_and_left_as_it_is(tmp_path):
    path = tmp_path / "bench.json"
    path.write_text("[1, 2]")
    with pytest.raises(ValueError, match="no file of measurements"):
        Results(path)
    assert path.read_text() == "[1, 2]"


def test_a_table_has_a_column_for_each_row_and_gaps_where_one_lacks_a_quantity():
    text = table([{"num_envs": 64, "rate": 1234.5}, {"num_envs": 128, "share": 0.125}])
    assert [line.split() for line in text.splitlines()] == [
        ["num_envs", "64", "128"],
        ["rate", "1,230"],
        ["share", "0.125"],
    ]


def test_success_counts_from_the_round_in_which_every_seed_has_it():
    def row(index, success):
        return {
            "round": str(index),
            "seconds": str(2.5 * index),
            "env_steps": str(100 * index),
            "success_rate": success,
        }

    measured = [row(0, ""), row(0, "1.0"), row(1, "0.99"), row(1, "0.97"), row(2, "0.98"), row(2, "1.0")]
    assert first_success(measured, 0.98) == (5.0, 200)
    assert first_success(measured, 0.999) == (None, None)


def test_a_run_finds_only_the_programs_that_it_is_given(tmp_path, monkeypatch):
    program = (
        "import json, os, pathlib, sys; folder = pathlib.Path(sys.argv[-1]); (folder / 'metrics.csv').touch();"
        "(folder / 'summary.json').write_text(json.dumps(dict(os.environ)))"
    )
    monkeypatch.setattr(whole_runs, "_TRAIN", (sys.executable, "-c", program))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "the user's")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("WARP_CACHE_PATH", raising=False)
    environment, _ = train(tmp_path, [], tmp_path / "programs")
    assert environment["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path / "programs")
    assert environment["WARP_CACHE_PATH"] == str(tmp_path / "cache" / "warp")


def test_a_row_of_stepping_has_the_rate_that_its_seconds_say():
    workload = Workload("reach", "c", num_envs=2, substeps=4, quick=True)
    stepping = Stepping(workload)
    ends = stepping.calls["raw"]()
    assert (
        ends.pipeline_state.qpos.shape[0] == 2
        and (ends.pipeline_state.qpos != workload.reset().pipeline_state.qpos).any()
    )
    row = stepping.row({"raw": 0.5})
    assert row["raw_env_steps_per_second"] == 2 * workload.env.episode_length / 0.5


class Machine:
    """A clock and calls that move it on, slower by ten times after a while."""

    def __init__(self):
        self.now = 0.0
        self.order = []

    def call(self, name, seconds):
        def run():
            self.order.append(name)
            self.now += seconds * (10 if self.now > 11 else 1)

        return run


@pytest.fixture
def machine(monkeypatch):
    machine = Machine()
    monkeypatch.setattr(timing.time, "perf_counter", lambda: machine.now)
    return machine


def test_a_machine_that_slows_down_does_so_for_all_calls(machine):
    found = timing.seconds_side_by_side({"short": machine.call("short", 1.0), "long": machine.call("long", 3.0)})
    assert machine.order == ["short", "long"] * 6
    assert found["long"] / found["short"] == pytest.approx(3.0)


def test_a_long_call_is_timed_five_times_and_a_short_one_for_some_seconds(machine):
    assert timing.seconds_per_call(machine.call("long", 60.0)) == pytest.approx(600.0)
    assert machine.order == ["long"] * 6
    machine.now, machine.order = 0.0, []
    assert timing.seconds_per_call(machine.call("short", 0.125)) == pytest.approx(0.125)
    assert len(machine.order) == 1 + 33


def test_fractions_add_up_to_one_and_find_what_was_put_in():
    """A round of four PPO phases and one of the discriminator, made of parts that are known."""
    workload = Workload("grasp", "c", 4, 8, quick=True)
    raw, policy, relabel, ppo, discriminator = 1.0, 0.25, 0.125, 0.5, 2.0
    rollout = raw + policy
    found = ppo_fractions(
        workload,
        {
            "raw_env_steps_per_second": workload.env_steps / raw,
            "rollout_env_steps_per_second": workload.env_steps / rollout,
            "relabel_seconds": relabel,
            "ppo_phase_seconds": rollout + relabel + ppo,
            "discriminator_phase_seconds": rollout + relabel + discriminator,
        },
    )
    parts = {
        "physics": 5 * raw,
        "policy_and_bookkeeping": 5 * policy,
        "relabelling": 5 * relabel,
        "ppo": 4 * ppo,
        "discriminator": discriminator,
    }
    assert found == pytest.approx({f"share_{name}": part / sum(parts.values()) for name, part in parts.items()})


def test_fractions_of_an_update_phase_add_up_to_one_and_find_what_was_put_in():
    workload = Workload("push", "c", 4, 8, quick=True)
    row = {
        "raw_env_steps_per_second": workload.env_steps / 2.0,
        "rollout_phase_seconds": 3.0,
        "update_phase_seconds": 8.0,
    }
    found = td3_fractions(workload, row)
    assert found == {"share_physics": 0.25, "share_policy_and_bookkeeping": 0.125, "share_updates": 0.625}

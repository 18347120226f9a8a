"""The command line, and, slowly, that each of its sections runs."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.bench import __main__ as bench
from experiments.bench import results
from hgail_jax.io.provenance import provenance
from tests.support import HERE

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


def test_reading_options_starts_no_backend():
    """Runs in processes of their own would find the GPU's memory taken."""
    program = (
        "from experiments.bench import __main__ as bench; from jax._src import xla_bridge\n"
        "bench.measure_compilation = lambda *arguments: print(xla_bridge.backends_are_initialized()) or ({}, {})\n"
        "next(bench.measure(bench.Options(section=('compile',))))"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]


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

"""The console command, and what all its commands share."""

import importlib.metadata
import json
import os
import runpy
import subprocess
import sys

import pytest

from hgail_jax import cli
from hgail_jax.cli import COMMANDS, main
from tests.support import SOURCES


@pytest.fixture
def prepared(monkeypatch):
    """Leaves this process as it is, and counts how often it would have been prepared."""
    calls = []
    monkeypatch.setattr("hgail_jax.cli.command_line.prepare_process", lambda: calls.append(1))
    return calls


@pytest.mark.parametrize("command", ["train", "play", "evaluate", "export", "demos", "robot"])
def test_a_command_is_given_its_options(command, monkeypatch, prepared):
    given = []
    module = importlib.import_module(f"hgail_jax.cli.{command}")
    monkeypatch.setattr(module, "main", given.append)
    main([command, "--task", "point", "--help"])
    assert given == [["--task", "point", "--help"]]
    assert len(prepared) == 1


def test_the_process_s_own_arguments_are_taken(monkeypatch, prepared):
    given = []
    monkeypatch.setattr("hgail_jax.cli.demos.main", given.append)
    monkeypatch.setattr(sys, "argv", ["hgail", "demos", "--episodes", "3"])
    main()
    assert given == [["--episodes", "3"]]


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_commands_are_listed(arguments, capsys, prepared):
    main(arguments)
    shown = capsys.readouterr().out
    assert shown.startswith("usage: hgail COMMAND")
    lines = [line.split() for line in shown.splitlines()]
    assert [words[0] for words in lines if words and words[0] in COMMANDS] == [
        "train",
        "play",
        "evaluate",
        "export",
        "demos",
        "robot",
    ]
    assert not prepared  # which would make folders


@pytest.mark.parametrize("name", ["fly", "Train", "", "--task", "command_line"])
def test_an_unknown_command_is_refused_in_one_line(name, capsys, prepared):
    with pytest.raises(SystemExit) as exit_info:
        main([name])
    assert exit_info.value.code == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    commands = "train, play, evaluate, export, demos, robot"
    assert shown.err == f"hgail: there is no command {name!r}; choose from {commands}\n"


def test_the_package_has_the_console_command():
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name="hgail")
    assert entry.load() is cli.main


def test_the_package_runs_as_a_module(monkeypatch, prepared):
    calls = []
    monkeypatch.setattr("hgail_jax.cli.main", lambda: calls.append("main"))
    runpy.run_module("hgail_jax", run_name="__main__")
    assert calls == ["main"]


def test_a_command_has_help_of_its_own(capsys, prepared):
    for command in COMMANDS:
        with pytest.raises(SystemExit) as exit_info:
            main([command, "--help"])
        assert exit_info.value.code == 0
        shown = capsys.readouterr().out
        assert f"usage: hgail {command}" in shown
        assert "None" not in shown


# Python has a module of that name, too.
USERS_TASK = """
from hgail_envs.point import Point

class Near(Point):
    success_threshold = 9.0
"""


def test_a_task_in_the_user_s_folder_is_found_first_and_programs_are_kept_in_the_cache(tmp_path):
    """The whole command, in a process of its own from the start."""
    (tmp_path / "test.py").write_text(USERS_TASK)
    kept = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment = kept | {
        "PYTHONPATH": SOURCES,
        "PYTHONSAFEPATH": "1",  # as of a console command, whose own folder Python looks in, not the user's
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    command = "import sys; from hgail_jax.cli import main; main(sys.argv[1:])"
    options = ["--task", "test:Near", "--episodes", "3", "--out", "near.npz"]
    done = subprocess.run(
        [sys.executable, "-c", command, "demos", *options],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("3 successful episodes of test:Near: return 0.0")  # wherever it is, it is near enough
    assert (tmp_path / "near.npz").exists()
    assert list((tmp_path / "cache" / "hgail_jax").iterdir())


@pytest.mark.parametrize(
    ("platform", "words"),
    [("cuda", ["train", "--task", "point"]), ("bogus", ["demos", "--task", "point"]), ("cuda", ["train", "--help"])],
)
def test_a_platform_that_is_not_there_is_named_in_one_line_and_help_needs_none(platform, words, forks):
    # JAX has read JAX_PLATFORMS already, into this.
    script = (
        f"import jax; jax.config.update('jax_platforms', {platform!r}); from hgail_jax.cli import main; main({words})"
    )
    done = forks.run(script, {"CUDA_VISIBLE_DEVICES": ""})
    line = f"hgail {words[0]}: JAX_PLATFORMS is '{platform}', and JAX finds no such device here;"
    line += " unset it, or set it to cpu\n"
    assert (done.returncode, done.stderr) == ((0, "") if "--help" in words else (2, line))
    assert not list(done.folder.iterdir())


A_TRAINING = """
from hgail_jax.cli import main
from tests.hgail_jax.trainer.stand_in import train_without_a_compiler
from tests.support import make_runs_tiny
make_runs_tiny()
train_without_a_compiler()
main(["train", "--task", "point", "--method", "ppo", "--seeds", "3", "--rounds", "1"])
"""


PLAIN = """
import sys
for one in filter(None, (sys.stdout, sys.stderr)):
    one.reconfigure(encoding="ascii", errors="strict")
"""


@pytest.mark.parametrize(
    ("closed", "out", "err"),
    [
        ((2,), "ppo on point, 3 seeds x 4 envs ->", ""),
        pytest.param((0, 1, 2), "", "", marks=pytest.mark.slow),
        pytest.param((1,), "", "compiling ", marks=pytest.mark.slow),
    ],
)
def test_a_training_needs_no_standard_streams_and_is_plain_where_they_take_ascii_alone(forks, closed, out, err):
    ended = forks.run(PLAIN + A_TRAINING, closed=closed)
    assert ended.returncode == 0
    assert ended.stdout.startswith(out) and (" +- " in ended.stdout) == bool(out)
    assert err in ended.stderr and (err or not ended.stderr)
    folder = ended.folder / "runs" / "point-ppo-1"
    names = {".lock", "config.json", "metrics.csv", "summary.json", "curves.png", "policies", "checkpoints"}
    assert {path.name for path in folder.iterdir()} == names
    assert json.loads((folder / "summary.json").read_text())["seeds"] == 3


def test_a_file_does_not_take_the_place_of_a_closed_stream(forks):
    """Else the messages that libraries write to descriptor 2 would go into it."""
    script = """
import os
from hgail_jax.cli.command_line import open_standard_streams
open_standard_streams()
with open("file", "w"):
    os.write(2, b"a message")
"""
    ended = forks.run(script, closed=(0, 1, 2))
    assert ended.returncode == 0
    assert (ended.folder / "file").read_text() == ""


A_USER_WITHOUT_AN_ENTRY = """
import pwd
def unknown(number):
    raise KeyError(number)
pwd.getpwuid = unknown
"""


def test_a_user_without_a_home_folder_has_help(forks, tmp_path):
    script = A_USER_WITHOUT_AN_ENTRY + "from hgail_jax.cli import main\nmain(['train', '--help'])"
    gone = dict.fromkeys(("HOME", "XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR"))
    done = forks.run(script, gone | {"TMPDIR": str(tmp_path)})
    assert done.returncode == 0
    assert done.stdout.startswith("usage: hgail train")
    assert done.stderr.count("\n") == 1 and "no home folder" in done.stderr
    assert not list(tmp_path.iterdir())  # a temporary cache is gone


@pytest.mark.parametrize(
    ("arguments", "numbers"),
    [
        (["--task", "grasp"], ["grasp", "--num-envs 512", "--substeps 8", "--exploration-noise 0.2 0.2 0.2 0.5"]),
        (["--task=point", "--method", "hgail-no"], ["point has --method hgail-no", "--num-envs 64", "--p-ht 0.0"]),
        (["--preset", "paper"], ["reach", "--exploration-noise 1.0"]),
    ],
)
def test_help_has_the_numbers_of_the_task(capsys, prepared, arguments, numbers):
    with pytest.raises(SystemExit):
        main(["train", *arguments, "--help"])
    (line,) = [line for line in capsys.readouterr().out.splitlines() if " has --method " in line]
    assert all(number in line for number in numbers)

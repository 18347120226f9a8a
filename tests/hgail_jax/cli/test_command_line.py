"""What is said of a command line that cannot be read, also of those drawn at random."""

import contextlib
import dataclasses
import io
import os
import sys
from typing import Annotated, Literal

import jax
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hgail_envs.randomization import LEVELS
from hgail_envs.validation import MOST
from hgail_jax.cli import command_line
from hgail_jax.cli import train as run
from hgail_jax.cli.command_line import parse, prepare_process, user_cache, with_new_names
from hgail_jax.trainer.train_options import TrainOptions, unless_given


@dataclasses.dataclass
class Options:
    """Of each kind that the commands have."""

    robot: Literal["fetch", "ur5e", "franka", "sawyer"] | None = None
    physics: Literal["c", "warp", "jax"] = "c"
    tables: tuple[Literal[1, 2, 3], ...] = ()
    seeds: int = 8
    """Number of seeds."""
    envs: Annotated[int | None, unless_given("the task's", "INT")] = None
    share: Annotated[float | None, unless_given("the task's", "FLOAT")] = None
    offset: tuple[float, float] = (0.0, 0.0)
    std: Annotated[tuple[float, ...] | None, unless_given("the task's", "FLOAT [FLOAT ...]")] = None


def refusal(capsys, *arguments):
    with pytest.raises(SystemExit) as exit_info:
        parse(Options, "it", None, list(arguments))
    assert exit_info.value.code == 2
    return capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--physics", "x"], "invalid choice 'x' for argument '--physics'. Expected one of ('c', 'warp', 'jax')."),
        (["--seeds", "eight"], "--seeds INT: invalid literal for int() with base 10: 'eight'"),
        (["--envs", "- a: b"], "--envs INT: invalid literal for int() with base 10: '- a: b'"),
        (["--share", "half"], "--share FLOAT: could not convert string to float: 'half'"),
        (["--offset", "0", "x"], "--offset FLOAT FLOAT: Could not parse arguments ['0', 'x'] into tuple type"),
        (["--std", "1", "x"], "--std FLOAT [FLOAT ...]: Could not find valid parse for arguments: ['1', 'x']"),
        (["--offset", "1"], "Missing value for argument '--offset'. Expected 2 values."),
        (["--sedes", "8"], "Unrecognized options: --sedes, 8; did you mean --seeds?"),
        (["--wind=8"], "Unrecognized options: --wind=8"),
    ],
)
def test_a_mistake_is_one_line_with_the_option_that_was_meant(capsys, words, said):
    error = refusal(capsys, *words)
    assert error.startswith(f"it: {said}")
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("of_user", "set_here"),
    [
        ({}, {"jax_compilation_cache_dir": "cache/hgail_jax", "jax_persistent_cache_min_compile_time_secs": 0.1}),
        ({"JAX_COMPILATION_CACHE_DIR": "/mine", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "2"}, {}),
    ],
)
def test_what_the_user_says_of_jax_s_cache_holds(monkeypatch, tmp_path, of_user, set_here):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", "cache")
    for name in ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"):
        monkeypatch.delenv(name, raising=False)
    for name, value in of_user.items():
        monkeypatch.setenv(name, value)
    changed = {}
    monkeypatch.setattr(jax.config, "update", changed.__setitem__)
    monkeypatch.setattr(sys, "path", ["elsewhere"])
    monkeypatch.setattr(command_line, "configure_xla", lambda: None)
    prepare_process()
    assert changed == set_here | {"jax_cpu_enable_async_dispatch": False}
    assert sys.path == [os.getcwd(), "elsewhere"]


@pytest.fixture
def no_home(monkeypatch, tmp_path):
    """A user without a home folder, and the folder of temporary files, which is empty."""

    def unknown(number):
        raise KeyError(f"getpwuid(): uid not found: {number}")

    monkeypatch.setattr("pwd.getpwuid", unknown)
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    return tmp_path / "temporary"


def test_without_a_home_folder_the_cache_is_temporary_and_a_line_says_so(no_home, capsys, monkeypatch):
    at_the_end = []
    monkeypatch.setattr("atexit.register", lambda call, *words, **options: at_the_end.append((call, words, options)))
    folder = user_cache()
    assert folder.parent == no_home and folder.is_dir()
    assert capsys.readouterr().err == (
        "compiled programs are not kept: this user has no home folder; XDG_CACHE_HOME may name a folder for them\n"
    )
    assert user_cache() == folder  # and Warp's, which reads the same variable
    assert capsys.readouterr().err == ""
    ((call, words, options),) = at_the_end
    call(*words, **options)
    assert not list(no_home.iterdir())


def test_without_a_home_folder_the_cache_is_in_the_folder_that_a_variable_names(no_home, capsys, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(no_home / "mine"))
    assert user_cache() == no_home / "mine"
    assert capsys.readouterr().err == ""


def test_a_home_folder_that_cannot_be_made_is_as_none(no_home, capsys, monkeypatch):
    (no_home / "file").touch()
    monkeypatch.setenv("HOME", str(no_home / "file"))
    assert user_cache().name.startswith("hgail-cache-")
    assert capsys.readouterr().err.startswith(f"compiled programs are not kept: {no_home}/file/.cache: Not a directory")


def test_a_cache_that_cannot_be_written_to_is_as_none(no_home, capsys, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(no_home))
    monkeypatch.setattr("os.access", lambda *_: False)  # root may write anywhere, so no mode of a folder would do
    assert user_cache().name.startswith("hgail-cache-")
    assert f"not kept: {no_home} cannot be written to" in capsys.readouterr().err


GOOD = (
    ["--task", "point"],
    ["--method", "ppo"],
    ["--seeds", "2"],
    ["--num-envs", "4"],
    ["--no-pretrain"],
    ["--strategy", "final"],
    ["--checkpoint-every", "5"],
    ["--p-ht", "0.5"],
)
CHOICES = {
    "--method": {"hgail", "hgail-no", "gail-demo", "gasil", "ppo", "gcsl"},
    "--preset": {"parallel", "paper"},
    "--impl": {"auto", "c", "jax", "warp"},
    "--strategy": {"future", "final"},
    "--randomize": set(LEVELS),
    "--reward": {"r1", "r2", "r3", "r4"},
}
words = st.text(st.characters(exclude_characters="\0"), max_size=20).filter(lambda text: not text.startswith("-"))


def no_number(kind):
    def is_none(text):
        try:
            kind(text)
        except ValueError:
            return text != "None"
        return False

    return words.filter(is_none)


def outside(least, most):
    return st.one_of(st.integers(max_value=least - 1), st.integers(min_value=most + 1)).map(str)


def bad(option, values):
    return values.map(lambda value: [option, value])


bad_arguments = st.one_of(
    *(bad(option, outside(1, MOST) | no_number(int)) for option in ("--seeds", "--num-envs", "--checkpoint-every")),
    bad("--rounds", outside(0, MOST) | no_number(int)),
    bad("--first-seed", outside(0, 2**31 - 2) | no_number(int)),
    bad("--substeps", outside(4, 20) | no_number(int)),
    bad("--p-ht", st.floats().filter(lambda share: not 0.0 <= share <= 1.0).map(str) | no_number(float)),
    *(bad(option, words.filter(lambda word, known=known: word not in known)) for option, known in CHOICES.items()),
    bad("--task", words.filter(lambda word: word not in ("point", "reach"))),
    bad("--task", words.map(lambda word: f"hgail_envs.point:{word}").filter(lambda task: not task.endswith(":Point"))),
    bad("--task", words.map(lambda word: f"{word}:Point")),
    bad("--resume", words.filter(lambda word: word != "auto").map(lambda word: f"no-{word}")),
    bad("--out", st.sampled_from(["", ".", "file", "file/run", "a" * 300])),
    words.map(lambda word: [f"--{word}!"]),
    words.map(lambda word: [word]),
    st.sampled_from(["--seeds", "--task", "--p-ht", "--out"]).map(lambda option: [option]),
    st.sampled_from(["--task", "--resume"]).map(lambda option: [option, "auto", "--out", "new"]),
)


@pytest.fixture
def closed_folder(tmp_path, monkeypatch):
    """A folder to run in, in which training is out of the question."""

    def refuse(*arguments):
        raise AssertionError("bad input was taken")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run, "train_run", refuse)
    (tmp_path / "file").write_text("")
    return tmp_path


@settings(max_examples=100, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
@given(good=st.lists(st.sampled_from(GOOD), unique_by=lambda pair: pair[0]), broken=bad_arguments)
def test_bad_arguments_are_one_line_and_write_nothing(closed_folder, good, broken):
    arguments = [word for pair in good if pair[0] != broken[0] for word in pair] + broken
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), pytest.raises(SystemExit) as exit_info:
        run.main(arguments)
    assert exit_info.value.code == 2
    said = errors.getvalue()
    assert said.startswith("hgail train: ")
    assert len(said.splitlines()) == 1
    assert len(said) > len("hgail train: x")
    assert os.listdir(closed_folder) == ["file"]


def test_a_tilde_that_a_shell_leaves_is_the_home_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    words = ["--out=~/runs/x", "--policy", "~/p.npz", "--settings", "a=~", "--demos", "x~/y", "--task=m:~"]
    expected = [f"--out={tmp_path}/runs/x", "--policy", f"{tmp_path}/p.npz", "--settings", f"a={tmp_path}"]
    assert with_new_names(words) == [*expected, "--demos", "x~/y", "--task=m:~"]


@pytest.mark.parametrize(
    ("words", "pretrain", "standardize"),
    [
        ([], None, None),
        (["--pretrain", "--no-standardize-reward"], True, False),
        (["--no-pretrain", "--standardize-reward"], False, True),
    ],
)
def test_a_flag_that_is_not_given_leaves_the_choice_to_the_task(words, pretrain, standardize):
    options = parse(TrainOptions, "hgail train", None, words)
    assert (options.pretrain, options.standardize_reward) == (pretrain, standardize)

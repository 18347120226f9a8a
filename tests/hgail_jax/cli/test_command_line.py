"""What is said of a command line that cannot be read."""

import dataclasses
import os
import sys
from typing import Annotated, Literal

import jax
import pytest

from hgail_jax.cli.command_line import parse, prepare_process
from hgail_jax.trainer.options import unless_given


@dataclasses.dataclass
class Options:
    """Of each kind that the commands have."""

    robot: Literal["fetch", "ur5e", "franka", "sawyer"] | None = None
    physics: Literal["c", "warp", "jax"] = "c"
    tables: tuple[Literal[1, 2, 3], ...] = ()
    seeds: int = 8
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
    ("option", "choices"),
    [("robot", "fetch, ur5e, franka, sawyer"), ("physics", "c, warp, jax"), ("tables", "1, 2, 3")],
)
def test_choices_are_listed_in_their_own_order(capsys, option, choices):
    assert refusal(capsys, f"--{option}", "x") == f"it: --{option} is 'x'; choose from {choices}\n"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--seeds", "eight"], "--seeds takes INT: 'eight' is not a whole number"),
        (["--envs", "- a: b"], "--envs takes INT: '- a: b' is not a whole number"),
        (["--share", "half"], "--share takes FLOAT: 'half' is not a number"),
        (["--offset", "0", "x"], "--offset takes FLOAT FLOAT: Could not parse arguments ['0', 'x']"),
        (["--std", "1", "x"], "--std takes FLOAT [FLOAT ...]: Could not find valid parse for arguments: ['1', 'x']"),
    ],
)
def test_a_value_that_cannot_be_read_is_said_with_its_option(capsys, words, said):
    error = refusal(capsys, *words)
    assert error.startswith(f"it: {said}")
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("of_user", "set_here"),
    [
        ({}, {"jax_compilation_cache_dir": "/cache/hgail_jax", "jax_persistent_cache_min_compile_time_secs": 0.1}),
        ({"JAX_COMPILATION_CACHE_DIR": "/mine", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "2"}, {}),
    ],
)
def test_what_the_user_says_of_jax_s_cache_holds(monkeypatch, of_user, set_here):
    monkeypatch.setenv("XDG_CACHE_HOME", "/cache")
    for name in ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"):
        monkeypatch.delenv(name, raising=False)
    for name, value in of_user.items():
        monkeypatch.setenv(name, value)
    changed = {}
    monkeypatch.setattr(jax.config, "update", changed.__setitem__)
    monkeypatch.setattr(sys, "path", ["elsewhere"])
    prepare_process()
    assert changed == set_here
    assert sys.path == [os.getcwd(), "elsewhere"]

"""What is said of a command line that cannot be read."""

import dataclasses
from typing import Literal

import pytest

from hgail_jax.cli.command_line import parse


@dataclasses.dataclass
class Options:
    """Of each kind that the commands have."""

    robot: Literal["fetch", "ur5e", "franka", "sawyer"] | None = None
    physics: Literal["c", "warp", "jax"] = "c"
    tables: tuple[Literal[1, 2, 3], ...] = ()


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

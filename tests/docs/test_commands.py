"""Commands and options in README and pages: those that there are, and they can be read."""

import contextlib
import re
import shlex
import tomllib

import pytest

from experiments.bench.__main__ import Options as Bench
from experiments.paper.__main__ import Options as Paper
from experiments.parity import Command as Parity
from experiments.transfer.__main__ import Options as Transfer
from hgail_jax.cli import command_line, demos, evaluate, export, play, robot, train
from tests import support
from tests.support import ROOT

COMMANDS = {
    "hgail train": train.Command,
    "hgail play": play.Options,
    "hgail evaluate": evaluate.Options,
    "hgail export": export.Options,
    "hgail demos": demos.Options,
    "hgail robot": robot.Options,
    "python experiments/run.py": train.Command,
    "python -m experiments.bench": Bench,
    "python -m experiments.paper": Paper,
    "python -m experiments.parity": Parity,
    "python -m experiments.transfer": Transfer,
}
PLACEHOLDERS = {"<robot>": "ur5e"}
OF_OTHERS = {"--help", "--gpus-per-task", "--gpu-bind", "--sample"}  # Slurm's, and the mutants'
PAGES = [ROOT / "CONTRIBUTING.md", ROOT / "experiments" / "README.md", *support.PAGES]

_BLOCK = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)
_INLINE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
_COMMAND = re.compile(rf"^(?:srun )?({'|'.join(map(re.escape, COMMANDS))})(?= |$)(.*)")


def typed(page):
    """Returns what a page gives to type, line by line, without comments."""
    blocks = [block.replace("\\\n", " ") for language, block in _BLOCK.findall(page) if language in ("", "bash", "sh")]
    lines = [line for block in blocks for line in block.splitlines()]
    return [line.split(" #")[0].strip() for line in [*lines, *_INLINE.findall(page)]]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_commands_can_be_read(path, capsys):
    for line in typed(path.read_text()):
        if found := _COMMAND.match(line):
            words = [PLACEHOLDERS.get(word, word) for word in shlex.split(found[2])]
            try:
                command_line.parse(COMMANDS[found[1]], found[1], "", words)
            except SystemExit as stop:
                assert stop.code == 0, f"{line}: {capsys.readouterr().err}"


def written(page):
    """Returns what the commands of a page write that must not exist, on a machine without a display."""
    found = [_COMMAND.match(line) for line in dict.fromkeys(typed(page))]
    names = []
    for program, words in [each.groups() for each in found if each and each[1].startswith("hgail") and each[2]]:
        with contextlib.suppress(SystemExit):  # of --help
            options = command_line.parse(COMMANDS[program], program, "", shlex.split(words))
            if getattr(options, "out", None) is not None:
                names.append(str(options.out))
            elif program == "hgail play" and not options.web:
                names.append(f"{options.task or options.policy}.mp4")
    return names


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_no_command_of_a_page_is_refused_for_what_another_wrote(path):
    names = written(path.read_text())
    assert sorted(set(names)) == sorted(names)


def test_a_film_that_is_written_twice_would_be_found():
    page = "`hgail play --task grasp`, `hgail play --task grasp --web` and `hgail play --task push --out grasp.mp4`"
    assert written(page) == ["grasp.mp4", "grasp.mp4"]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_make_and_pytest_have_what_is_asked_for(path):
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for line in typed(path.read_text()):
        program, *words = line.split() or [""]
        assert program != "make" or set(words) <= set(targets), line
        assert program != "pytest" or (ROOT / words[-1]).exists(), line


def test_make_installs_all_extras_but_those_for_a_gpu():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    wanted = {
        re.split(r"[<>=\[]", need)[0].lower() for name in extras.keys() - {"gpu", "warp"} for need in extras[name]
    }
    locked = set(re.findall(r"^([\w-]+)(?:==| )", (ROOT / "requirements.lock").read_text(), re.MULTILINE))
    assert wanted <= locked
    assert "warp-lang" not in locked


def test_a_command_that_is_not_there_would_be_found(capsys):
    (line,) = typed("```python\nimport envs\n```\nand\n```\nhgail train --sedes 8  # a comment\n```")
    found = _COMMAND.match(line)
    with pytest.raises(SystemExit):
        command_line.parse(COMMANDS[found[1]], found[1], "", shlex.split(found[2]))
    assert "--sedes" in capsys.readouterr().err


@pytest.fixture(scope="module")
def options():
    """All options of all commands."""
    known = set()
    for command in COMMANDS.values():
        for each in getattr(command, "__args__", [command]):
            known |= {f"--{name.replace('_', '-')}" for name in each.__dataclass_fields__}
    return known | {name.replace("--", "--no-", 1) for name in known} | OF_OTHERS


@pytest.mark.parametrize("path", [path for path in PAGES if path.name != "upgrading.md"], ids=lambda path: path.name)
def test_options_in_the_text_are_those_that_there_are(path, options):
    for line in _INLINE.findall(path.read_text()):
        if line.startswith("--"):
            assert re.split("[ =]", line)[0] in options, line

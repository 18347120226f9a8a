"""Command lines that nobody should type, drawn at random."""

import contextlib
import io
import os

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hgail_envs.randomization import LEVELS
from hgail_envs.validation import MOST
from hgail_jax.cli import train as run

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


@settings(max_examples=300, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
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

"""Without LeRobot there is a line that says how to install it."""

import importlib.util

import pytest

from hgail_jax.cli import demos, export, train


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        (export, ["--task", "reach", "--format", "lerobot"]),
        (demos, ["--task", "reach", "--format", "lerobot"]),
        (train, ["--task", "reach", "--method", "gail-demo", "--demos", "."]),
    ],
)
def test_what_is_missing_is_one_line_and_nothing_is_written(tmp_path, monkeypatch, capsys, command, arguments):
    monkeypatch.chdir(tmp_path)
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "lerobot" else find(name))
    with pytest.raises(SystemExit) as ended:
        command.main(arguments)
    error = capsys.readouterr().err
    assert (ended.value.code, error.count("\n")) == (2, 1)
    assert "LeRobot is missing: pip install 'lerobot[training,evaluation]'" in error
    assert not list(tmp_path.iterdir())

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
@pytest.mark.parametrize("part", ["lerobot", "datasets"])
def test_what_is_missing_is_one_line_and_nothing_is_written(tmp_path, monkeypatch, capsys, command, arguments, part):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text("{}")
    find = importlib.util.find_spec
    parts = dict.fromkeys(("lerobot", "datasets", "av"), True) | {part: None}
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: parts[name] if name in parts else find(name))
    with pytest.raises(SystemExit) as ended:
        command.main(arguments)
    error = capsys.readouterr().err
    assert (ended.value.code, error.count("\n")) == (2, 1)
    assert f"LeRobot is missing, or a part of it ({part}): pip install 'lerobot[training,evaluation]~=0.6.1'" in error
    assert [path.name for path in tmp_path.iterdir()] == ["meta"]


def test_a_folder_of_anything_else_is_no_dataset(tmp_path, capsys):
    with pytest.raises(SystemExit):
        train.main(["--task", "reach", "--method", "gail-demo", "--demos", str(tmp_path)])
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "is no LeRobotDataset: it has no meta/info.json" in error

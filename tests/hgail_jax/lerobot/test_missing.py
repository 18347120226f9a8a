"""Refusals in one line: LeRobot is not installed, or cannot run a policy."""

import dataclasses
import importlib.util

import pytest

from hgail_envs.scenes import assets_directory
from hgail_jax.cli import demos, export, train
from hgail_jax.io.policy import load_any_policy
from hgail_jax.lerobot import check_shown
from tests.support import refused


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
    line = f"LeRobot is missing, or a part of it ({part}): pip install 'lerobot[training,evaluation]~=0.6.1'"
    refused(command.main, arguments, line, capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["meta"]


def test_a_policy_that_sees_depth_is_not_exported():
    policy = load_any_policy(assets_directory() / "policies" / "push-camera.npz")
    convolutions = [(policy.eyes.convolutions[0][0][:, :, ::3], policy.eyes.convolutions[0][1])]
    eyes = policy.eyes._replace(convolutions=convolutions + policy.eyes.convolutions[1:])
    check_shown(policy)
    with pytest.raises(ValueError, match="the policy sees depth; LeRobot's environment of push shows colours"):
        check_shown(dataclasses.replace(policy, eyes=eyes, kind="depth"))


def test_a_folder_of_anything_else_is_no_dataset(tmp_path, capsys):
    words = ["--task", "reach", "--method", "gail-demo", "--demos", str(tmp_path)]
    refused(train.main, words, "is no LeRobotDataset: it has no meta/info.json", capsys)

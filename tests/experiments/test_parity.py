"""The command that measures parity, with the measuring left out."""

import json

import mujoco
import numpy as np
import pytest
from gymnasium_robotics.utils import mujoco_utils

from experiments import parity
from hgail_envs.tasks.reference import make_reference
from tests.support import refused


def test_rows_are_written_with_what_made_them(tmp_path, monkeypatch):
    monkeypatch.setattr(parity, "measure", lambda task, impl, substeps: {"task": task, "drift_median_mm": 5.0})
    parity.main(["--out", str(tmp_path / "new" / "parity.json")])
    written = json.loads((tmp_path / "new" / "parity.json").read_text())
    assert {row["task"] for row in written["rows"]} == {"reach", "grasp", "push", "pick-and-place", "slide"}
    assert written["made_by"]["versions"]["mujoco"] == mujoco.__version__


def test_a_file_that_cannot_be_written_is_noticed_before_anything_is_measured(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(parity, "measure", lambda *arguments: pytest.fail("it measured"))
    (tmp_path / "file").touch()
    words = ["--out", str(tmp_path / "file" / "parity.json")]
    refused(parity.main, words, f"parity: {tmp_path}/file: Not a directory\n", capsys)


def test_the_reference_knows_joints_by_numbers():
    """Those of newer MuJoCos are no numbers, and it looks for a number among them."""
    env = make_reference("FetchReach-v4", max_episode_steps=7).unwrapped
    hinge = env.model.joint("robot0:elbow_flex_joint").type[0]
    kinds = mujoco_utils.mujoco.mjtJoint
    assert {type(kind) for kind in vars(kinds).values()} == {int}
    assert hinge == kinds.mjJNT_HINGE
    mujoco_utils.set_joint_qpos(env.model, env.data, "robot0:elbow_flex_joint", 0.5)
    assert np.isclose(env.data.joint("robot0:elbow_flex_joint").qpos[0], 0.5)

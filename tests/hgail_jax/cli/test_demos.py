import dataclasses
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from hgail_envs.point import Point
from hgail_jax import TrainOptions, load_demonstrations
from hgail_jax.cli import demos
from hgail_jax.cli import train as run
from hgail_jax.io.policy import load_policy
from hgail_jax.trainer.train_options import plan
from tests.support import ROOT, refused

POLICIES = ROOT / "assets" / "policies"


def test_demonstrations_are_recorded_and_trained_on(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    demos.main(["--task", "point", "--episodes", "20"])
    recorded = load_demonstrations("demonstrations/point.npz", "point")
    assert recorded.episodes == 20
    assert (recorded.success == 1.0).all()
    moved = recorded.features[:, :-1] + 0.03 * recorded.action[:, :-1]
    np.testing.assert_allclose(recorded.features[:, 1:], moved, atol=1e-5)
    options = TrainOptions(task="point", method="gail-demo", demos=Path("demonstrations/point.npz"), seeds=2)
    prepared = plan(options, "cpu")
    assert prepared.identity()["demonstrations"] == recorded.sha256
    for expert_action in prepared.init().expert.action:
        np.testing.assert_array_equal(expert_action, recorded.action.reshape(-1, 3))


def test_another_robot_demonstrates(tmp_path, monkeypatch):
    pytest.importorskip("gymnasium_robotics")
    monkeypatch.chdir(tmp_path)
    demos.main(["--task", "reach", "--episodes", "3", "--robot", "franka"])
    recorded = load_demonstrations("demonstrations/reach.npz", "reach")
    assert recorded.made_by["robot"] == "franka"
    np.testing.assert_allclose(recorded.features[:, 0, :3], [[1.344, 0.749, 0.6]] * 3, atol=1e-3)


def test_a_controller_demonstrates_what_a_learner_observes(tmp_path, monkeypatch):
    """TD3 sees the cube of grasp at each step: the goal's place, since the cube is grasped where it lies."""
    monkeypatch.chdir(tmp_path)
    demos.main(["--task", "grasp", "--learner", "td3", "--episodes", "2", "--out", "d.npz"])
    recorded = load_demonstrations("d.npz", "grasp")
    cube = recorded.features[..., 8:] + recorded.features[..., :3]
    np.testing.assert_allclose(cube[:, 0], recorded.goal[:, 0, :3], atol=1e-3)
    assert np.ptp(cube[..., :2], axis=1).max() > 1e-4  # the closing hand moves it
    options = TrainOptions(task="grasp", learner="td3", method="gail-demo", demos=Path("d.npz"), seeds=1)
    assert plan(options, "cpu").identity()["demonstrations"] == recorded.sha256
    with pytest.raises(ValueError, match="hgail demos has a --learner"):
        plan(dataclasses.replace(options, learner="ppo"), "cpu")


def test_a_policy_demonstrates(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = POLICIES / "reach.npz"
    demos.main(["--task", "reach", "--policy", str(path), "--episodes", "3", "--out", "d.npz"])
    recorded, policy = load_demonstrations("d.npz", "reach"), load_policy(path)
    observation = np.concatenate([recorded.features, recorded.goal], axis=-1)
    np.testing.assert_allclose(recorded.action, policy(observation), atol=1e-5)
    assert recorded.success.tolist() == [1.0] * 3
    assert recorded.made_by["controller"] == "policy"
    assert recorded.made_by["physics"]["substeps"] == 20


class Silent(Point):
    """A task that nothing demonstrates."""

    controllers: ClassVar = {}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "poke"], "unknown task 'poke'"),
        (["--task", f"{__name__}:Silent"], f"no controller demonstrates '{__name__}:Silent'"),
        (["--task", "point", "--episodes", "0"], "episodes is 0"),
        (["--task", "point", "--seed", "-1"], "seed is -1"),
        (["--task", "point", "--robot", "franka"], "--robot is for the tasks of an arm; 'point' is none"),
        (["--robot", "panda"], "robot is 'panda'; choose from fetch, franka"),
        (["--task", "push", "--policy", str(POLICIES / "reach.npz")], "the policy is for 'reach', not for 'push'"),
        (["--task", "reach", "--policy", str(POLICIES / "reach-robust.npz")], "the policy reads 39 numbers"),
        (["--task", "reach", "--policy", "reach", "--learner", "td3"], "--learner is for a controller"),
        (["--task", "reach", "--learner", "sac"], "learner is 'sac'; choose from ppo, td3, crl"),
        (["--task", "reach", "--camera", "front"], "--camera goes with --format lerobot"),
        (["--task", "reach", "--target", "seen"], "--target goes with --format lerobot"),
        (["--task", "reach", "--picture-size", "64"], "--picture-size goes with --format lerobot"),
        (["--task", "point", "--out", "file"], "file exists already"),
        (["--task", "point", "--out", "file/point.npz"], "file: Not a directory"),
    ],
)
def test_bad_demonstrations_are_one_line_and_write_nothing(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(demos, "record", lambda *arguments: pytest.fail("it was noticed late"))
    (tmp_path / "file").write_text("")
    refused(demos.main, arguments, message, capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    "arguments", [["--method", "gail-demo"], ["--demos", "missing"], ["--method", "gail-demo", "--demos", "missing"]]
)
def test_a_method_has_the_demonstrations_it_needs(tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.chdir(tmp_path)
    refused(run.main, ["--task", "point", *arguments], "hgail train: ", capsys)
    assert not list(tmp_path.iterdir())

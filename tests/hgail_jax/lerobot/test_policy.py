"""Exported policies act in LeRobot as they do here."""

import jax
import numpy as np
import pytest

from hgail_jax.cli import export
from hgail_jax.io.policy import load_policy, save_policy
from hgail_jax.vision.network import init_eyes
from hgail_jax.vision.policy import CameraPolicy
from tests.support import ROOT, refused

torch = pytest.importorskip("torch", reason="PyTorch is missing")
pytest.importorskip("lerobot", reason="LeRobot is missing")

from lerobot.envs import preprocess_observation
from lerobot.policies import make_policy, make_pre_post_processors

from hgail_jax.lerobot.environment import HgailEnvConfig
from hgail_jax.lerobot.policy import HgailConfig, export_lerobot

POLICIES = ROOT / "assets" / "policies"


def acting(folder, **options):
    """Returns a policy of a folder as a function of what the environment shows, made as lerobot-eval makes it."""
    config = HgailConfig.from_pretrained(folder)
    config.pretrained_path = folder
    policy = make_policy(config, env_cfg=HgailEnvConfig(**options))
    steps = {"device_processor": {"device": "cpu"}, "rename_observations_processor": {"rename_map": {}}}
    before, after = make_pre_post_processors(config, str(folder), preprocessor_overrides=steps)

    def act(observation):
        with torch.inference_mode():
            return after(policy.select_action(before(preprocess_observation(observation)))).numpy()

    return act, policy


@pytest.mark.parametrize("task", ["reach", "push", "pick-and-place", "grasp", "tower"])
def test_actions_are_those_of_the_policy(tmp_path, task):
    """From a normal observation to one that is clipped; tanh and relu, with clipped and squashed actions."""
    policy, folder = load_policy(POLICIES / f"{task}.npz"), tmp_path / "folder"
    export.main(["--task", task, "--format", "lerobot", "--out", str(folder)])
    act, _ = acting(folder, task=task)
    drawn = np.random.default_rng(0).normal(size=(64, policy.observation_size))
    seen = (policy.mean + policy.std * drawn * np.linspace(0.1, 8.0, 64)[:, None]).astype(np.float32)
    np.testing.assert_allclose(act({"environment_state": seen}), policy(seen), atol=1e-5)


@pytest.mark.parametrize(("cameras", "size"), [(("front", "wrist"), 18), (("side",), 33)])
def test_actions_from_pictures_are_those_of_the_policy(tmp_path, cameras, size):
    """Sizes that are odd for the strides."""
    rng = np.random.default_rng(0)
    eyes = init_eyes(jax.random.key(0), len(cameras), 10, (4, 5, 6, 7), (8, 9), (4, 3))
    eyes = jax.tree.map(lambda values: np.asarray(values + 0.1 * rng.normal(size=values.shape), np.float32), eyes)
    mean, std, centre = (rng.uniform(0.5, 1.0, count).astype(np.float32) for count in (10, 10, 3))
    policy = CameraPolicy("push", 4, cameras, size, mean, std, centre, eyes)
    save_policy(tmp_path / "policy.npz", policy)
    folder = tmp_path / "folder"
    export.main(["--policy", str(tmp_path / "policy.npz"), "--format", "lerobot", "--out", str(folder)])
    act, _ = acting(folder, task="push", cameras=",".join(cameras), picture_size=size)
    pictures = rng.integers(0, 256, (7, *policy.pictures_shape)).astype(np.uint8)
    numbers = (mean + std * rng.normal(size=(7, 10))).astype(np.float32)
    shown = {"agent_pos": numbers, "pixels": {name: pictures[:, i] for i, name in enumerate(cameras)}}
    expected = policy(pictures, numbers)
    assert np.ptp(expected, axis=0).max() > 0.1
    np.testing.assert_allclose(act(shown), expected, atol=1e-5)


def test_a_policy_learns_from_actions(tmp_path):
    """lerobot-train takes its loss, parameters and optimizer."""
    export_lerobot(tmp_path, load_policy(POLICIES / "push.npz"))
    _, policy = acting(tmp_path, task="push")
    seen = torch.tensor(load_policy(POLICIES / "push.npz").mean)[None]
    batch = {"observation.environment_state": seen, "action": torch.full((1, 4), 0.3)}
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    losses = []
    for _ in range(50):
        loss, _ = policy.forward(batch)
        losses.append(loss.item())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert losses[-1] < 0.1 * losses[0]
    assert policy.predict_action_chunk(batch).shape == (1, 1, 4)


def test_an_action_that_is_clipped_is_learnt_from(tmp_path):
    export_lerobot(tmp_path, load_policy(POLICIES / "reach.npz"))
    _, policy = acting(tmp_path, task="reach")
    assert not policy.config.squash
    batch = {"observation.environment_state": policy.mean[None], "action": torch.full((1, 4), 0.3)}
    with torch.no_grad():
        policy.layers[-1].bias += 10.0
    assert (policy.select_action(batch) == 1.0).all()
    policy.forward(batch)[0].backward()
    assert (policy.layers[-1].bias.grad > 0.0).all()


def test_a_policy_of_other_sizes_is_refused(tmp_path):
    export_lerobot(tmp_path, load_policy(POLICIES / "reach.npz"))
    act, _ = acting(tmp_path, task="push")
    with pytest.raises(ValueError, match=r"^observation.environment_state is missing; leave out --env.cameras$"):
        act({"agent_pos": np.zeros((2, 10), np.float32)})
    with pytest.raises(ValueError, match=r"environment_state is \(19,\); this policy of reach reads \(9,\)"):
        act({"agent_pos": np.zeros((2, 10), np.float32), "environment_state": np.zeros((2, 19), np.float32)})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--task", "reach", "--randomize", "full"],
            "the policy reads 39 numbers; LeRobot's environment of reach shows 9",
        ),
        (["--policy", str(POLICIES / "grasp-other-arms.npz")], "shows 12"),
        (["--task", "reach", "--out", "there"], "there exists already"),
    ],
)
def test_bad_exports_are_one_line_and_write_nothing(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").write_text("")
    refused(export.main, ["--format", "lerobot", *arguments], message, capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["there"]

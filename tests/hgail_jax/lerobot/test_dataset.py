"""Datasets beside the roll-outs that they come from."""

import json
import shutil
import threading
import time

import jax
import numpy as np
import pytest

from hgail_jax import TrainOptions
from hgail_jax.cli import demos, train
from hgail_jax.io.policy import load_policy
from hgail_jax.trainer.train_options import plan
from tests.support import ROOT, refused

pytest.importorskip("lerobot", reason="LeRobot is missing")

import av
from lerobot.datasets import LeRobotDataset, compute_stats

import hgail_envs
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.pictures import Pictures
from hgail_jax.lerobot.dataset import read_dataset, write_dataset
from hgail_jax.lerobot.environment import HgailEnvConfig
from hgail_jax.rollout import rollout

POLICY = ROOT / "assets" / "policies" / "reach.npz"
EPISODES = 3
USE_PICTURES = "hgail_jax.lerobot.dataset.use_pictures"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A dataset of each kind, by its cameras; that with pictures is joined of a part of two episodes and one of one."""
    folder = tmp_path_factory.mktemp("datasets")
    words = ["--task", "reach", "--policy", str(POLICY), "--episodes", str(EPISODES), "--format", "lerobot"]
    demos.main([*words, "--out", str(folder / "numbers")])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hgail_jax.lerobot.dataset._PART", 2)
        demos.main([*words, "--out", str(folder / "pictures"), "--camera", "side,front", "--picture-size", "32"])
    return folder


@pytest.fixture(scope="module")
def expected():
    """The roll-out, by a policy in NumPy's stead, of as many attempts as the command makes."""
    policy, env = load_policy(POLICY), hgail_envs.make("reach", substeps=20)
    camera = CameraEnv(env, Pictures(env, ["side", "front"], 32))
    size, attempts = env.observation_size, EPISODES + EPISODES // 4 + 4

    def act(observation, rng):
        return policy(observation[:, :size], xp=jax.numpy), observation

    trajectory = jax.jit(lambda rng: rollout(camera, act, rng, attempts))(jax.random.key(0))
    assert np.asarray(trajectory.outcome.success)[:EPISODES].all()
    return camera, jax.tree.map(np.asarray, trajectory)


def here(env):
    """Returns `use_pictures` in this process, for episodes whose whole observation was noted."""

    def use_pictures(pictures, batches, use, *arguments):
        return map(use, (np.asarray(env.see(batch)) for batch in batches), *arguments)

    return use_pictures


def columns(dataset, name):
    """Returns a column by episode, `[episodes, steps, ...]`."""
    values = np.stack([np.asarray(value) for value in dataset.hf_dataset[name]])
    return values.reshape(EPISODES, -1, *values.shape[1:])


def test_numbers_are_those_of_the_roll_out(written, expected):
    env, trajectory = expected
    dataset = LeRobotDataset("local/numbers", root=written / "numbers")
    assert (dataset.num_episodes, len(dataset), dataset.fps) == (EPISODES, EPISODES * 50, 25)
    observation = np.concatenate([trajectory.features, trajectory.desired], axis=-1).swapaxes(0, 1)[:EPISODES, :50]
    action, reward = (getattr(trajectory, name).swapaxes(0, 1)[:EPISODES] for name in ("action", "reward"))
    np.testing.assert_allclose(columns(dataset, "observation.environment_state"), observation, atol=1e-6)
    np.testing.assert_allclose(columns(dataset, "observation.state"), observation[..., env.known], atol=1e-6)
    np.testing.assert_allclose(columns(dataset, "action"), action, atol=1e-6)
    np.testing.assert_array_equal(columns(dataset, "next.reward"), reward)
    np.testing.assert_array_equal(columns(dataset, "next.success"), reward == 0.0)
    np.testing.assert_array_equal(columns(dataset, "next.done"), [[False] * 49 + [True]] * EPISODES)
    assert dataset[60]["task"] == "Move the gripper to the target."
    assert dataset.meta.robot_type == "fetch"
    assert dataset.features["observation.state"]["names"][-1] == "target position z"
    np.testing.assert_allclose(dataset.meta.stats["action"]["mean"], action.mean(axis=(0, 1)), atol=1e-5)


def test_pictures_are_those_of_the_roll_out(written, expected):
    """But for what the encoder of the film loses."""
    env, trajectory = expected
    dataset = LeRobotDataset("local/pictures", root=written / "pictures")
    assert len(dataset) == EPISODES * 50
    assert "observation.environment_state" not in dataset.features
    np.testing.assert_array_equal(columns(dataset, "index"), np.arange(EPISODES * 50).reshape(EPISODES, 50))
    np.testing.assert_array_equal(columns(dataset, "episode_index"), [[episode] * 50 for episode in range(EPISODES)])
    for name in ("action", "reward"):
        values = getattr(trajectory, name).swapaxes(0, 1)[:EPISODES]
        np.testing.assert_allclose(columns(dataset, name if name == "action" else "next.reward"), values, atol=1e-6)
    seen = np.asarray(env.see(trajectory.noted[::7, :EPISODES])) / 255.0  # [steps, episodes, cameras, 32, 32, 3]
    for index, camera in enumerate(("side", "front")):
        read = [
            [dataset[50 * episode + step][f"observation.images.{camera}"] for step in range(0, 50, 7)]
            for episode in range(EPISODES)
        ]
        error = np.abs(np.array(read).transpose(1, 0, 3, 4, 2) - seen[:, :, index])
        assert error.mean() < 0.02
        others = np.abs(np.array(read).transpose(1, 0, 3, 4, 2) - seen[:, :, 1 - index])
        assert error.mean() < 0.2 * others.mean()
        of_all = np.asarray(env.see(trajectory.noted[:50, :EPISODES]))[:, :, index] / 255.0
        stats = dataset.meta.stats[f"observation.images.{camera}"]
        np.testing.assert_allclose(stats["mean"].ravel(), of_all.mean(axis=(0, 1, 2, 3)), atol=1e-4)
        np.testing.assert_allclose(stats["std"].ravel(), of_all.std(axis=(0, 1, 2, 3)), atol=1e-3)


def test_a_dataset_has_what_the_environment_shows(written):
    for name, options in (("numbers", {}), ("pictures", {"cameras": "side,front", "picture_size": 32})):
        config = HgailEnvConfig(task="reach", **options)
        shown = {config.features_map[name]: tuple(feature.shape) for name, feature in config.features.items()}
        features = LeRobotDataset(f"local/{name}", root=written / name).features
        assert {name: tuple(feature["shape"]) for name, feature in features.items() if name in shown} == shown


def test_a_dataset_demonstrates(written, expected):
    _, trajectory = expected
    run = plan(TrainOptions(task="reach", method="gail-demo", demos=written / "numbers", seeds=1), "cpu")
    samples = run.demonstrations
    action = trajectory.action.swapaxes(0, 1)[:EPISODES].reshape(-1, 4)
    np.testing.assert_allclose(samples.action, action, atol=1e-6)
    np.testing.assert_allclose(
        samples.observation[:, :6], trajectory.features[:-1].swapaxes(0, 1)[:EPISODES].reshape(-1, 6), atol=1e-6
    )
    assert len(samples.weight) == EPISODES * 50


def test_pictures_are_those_of_the_episodes_that_are_chosen(tmp_path, monkeypatch, expected):
    env, trajectory = expected
    monkeypatch.setattr(USE_PICTURES, here(env))
    write_dataset(tmp_path / "chosen", "reach", env, trajectory, np.array([2, 0]), {}, print)
    read = LeRobotDataset("local/chosen", root=tmp_path / "chosen")
    for place, episode in enumerate((2, 0)):
        seen = np.asarray(env.see(trajectory.noted[10, episode]))[0] / 255.0
        pictures = [read[50 * index + 10]["observation.images.side"].permute(1, 2, 0).numpy() for index in (0, 1)]
        errors = [np.abs(picture - seen).mean() for picture in pictures]
        assert errors[place] < 0.02
        assert errors[place] < errors[1 - place]


def test_a_slow_encoder_loses_no_picture(tmp_path, monkeypatch, expected):
    """LeRobot drops a picture that waits for a tenth of a second."""
    env, trajectory = expected
    monkeypatch.setattr(USE_PICTURES, here(env))
    begun = set()

    def slow(picture):
        if threading.get_ident() not in begun:
            begun.add(threading.get_ident())
            time.sleep(0.5)
        return downsample(picture)

    downsample = compute_stats.auto_downsample_height_width
    monkeypatch.setattr(compute_stats, "auto_downsample_height_width", slow)
    write_dataset(tmp_path / "slow", "reach", env, trajectory, np.array([0]), {}, print)
    assert begun
    for film in (tmp_path / "slow").rglob("*.mp4"):
        with av.open(film) as container:
            assert sum(1 for _ in container.decode(video=0)) == 50


def test_what_fails_half_way_leaves_nothing(tmp_path, monkeypatch, expected):
    env, trajectory = expected

    def use_pictures(pictures, batches, use, *arguments):
        yield from here(env)(pictures, batches[:1], use, *arguments)
        raise OSError("no space is left")

    monkeypatch.setattr("hgail_jax.lerobot.dataset._PART", 1)
    monkeypatch.setattr(USE_PICTURES, use_pictures)
    with pytest.raises(OSError, match="no space is left"):
        write_dataset(tmp_path / "half", "reach", env, trajectory, np.array([0, 1]), {}, print)
    assert not list(tmp_path.iterdir())


def test_a_dataset_says_what_made_it(written):
    made = json.loads((written / "pictures" / "meta" / "made_by.json").read_text())
    assert (made["controller"], made["seed"], made["physics"]["substeps"]) == ("policy", 0, 20)
    assert made["versions"]["lerobot"].startswith("0.6")


def changed(written, folder, **information):
    """Returns a copy of a dataset with other entries in its meta/info.json."""
    shutil.copytree(written / "numbers", folder)
    path = folder / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | information))
    return folder


def test_datasets_that_lerobot_cannot_read_are_a_value_error(tmp_path, written):
    env = hgail_envs.make("reach")
    for version in ("v2.1", "v2.0"):
        older = changed(written, tmp_path / version, codebase_version=version)
        with pytest.raises(ValueError, match=f"{version} is of another version of LeRobot"):
            read_dataset(older, "reach", env)
    for part in ("data", "meta/episodes"):
        shutil.copytree(written / "numbers", tmp_path / part)
        shutil.rmtree(tmp_path / part / part)
        with pytest.raises(ValueError, match="was not written to its end"):
            read_dataset(tmp_path / part, "reach", env)


def test_what_lerobot_recorded_demonstrates(tmp_path, written):
    """It names the features as the environment does."""
    env, folder = hgail_envs.make("reach"), tmp_path / "recorded"
    first = LeRobotDataset("local/numbers", root=written / "numbers")
    names = {"agent_pos": "observation.state", "environment_state": "observation.environment_state", "action": "action"}
    features = {name: first.features[own] for name, own in names.items()}
    recorded = LeRobotDataset.create("local/recorded", 25, features, root=folder)
    for step in range(50):
        recorded.add_frame({name: first[step][own] for name, own in names.items()} | {"task": "reach"})
    recorded.save_episode()
    recorded.finalize()
    read, whole = (read_dataset(path, "reach", env) for path in (folder, written / "numbers"))
    np.testing.assert_array_equal(read.features, whole.features[:, :50])
    np.testing.assert_array_equal(read.action, whole.action[:, :50])


@pytest.mark.parametrize(
    ("task", "name", "line"),
    [
        ("push", "numbers", "has observation.environment_state of the shape (9,); push has 19 numbers"),
        ("reach", "pictures", "has no observation.environment_state; a dataset with pictures is no demonstration"),
    ],
)
def test_other_datasets_are_one_line(written, capsys, task, name, line):
    words = ["--task", task, "--method", "gail-demo", "--seeds", "1", "--demos", str(written / name)]
    refused(train.main, words, line, capsys)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--task", "push", "--policy", str(POLICY)], "the policy is for 'reach', not for 'push'"),
        (["--task", "reach", "--camera", "behind"], "has no camera 'behind'"),
        (["--task", "reach", "--target", "seen"], "--target goes with --camera"),
        (
            ["--task", "reach", "--camera", "side", "--picture-size", "33"],
            "picture-size is 33; a film needs",
        ),
        (["--task", "poke"], "unknown task 'poke'"),
    ],
)
def test_bad_options_are_one_line_and_write_nothing(tmp_path, capsys, arguments, line):
    refused(demos.main, [*arguments, "--format", "lerobot", "--out", str(tmp_path / "new")], line, capsys)
    assert not list(tmp_path.iterdir())

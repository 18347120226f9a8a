"""LeRobot's environment beside Gymnasium's of the same task."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest

import hgail_envs
from hgail_envs.vector import GoalVectorEnv
from hgail_jax.io.policy import load_policy
from tests.support import ROOT

pytest.importorskip("lerobot", reason="LeRobot is missing")

from lerobot.envs import env_to_policy_features, make_env
from lerobot.envs.utils import NEW_ROLLOUT_OPTION

from hgail_jax.lerobot.environment import HgailEnvConfig, sentence


def made(count, **options):
    config = HgailEnvConfig(**options)
    return config, make_env(config, n_envs=count)["hgail"][0]


def test_it_shows_what_the_task_shows():
    config, env = made(3, task="pick-and-place")
    observation, _ = env.reset(seed=[5, 6, 7], options={NEW_ROLLOUT_OPTION: True})
    task = hgail_envs.make("pick-and-place", substeps=20)
    reference = GoalVectorEnv(task, 3)
    expected, _ = reference.reset(seed=5)
    action = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 4)).astype(np.float32)
    for _ in range(2):
        features, goal = expected["observation"], expected["desired_goal"]
        np.testing.assert_array_equal(observation["environment_state"], np.concatenate([features, goal], axis=1))
        own = [i for i, one in enumerate(task.features_layout.numbers) if one.title.startswith(("gripper", "gap"))]
        np.testing.assert_array_equal(observation["agent_pos"], np.concatenate([features[:, own], goal], axis=1))
        assert env.observation_space.contains(observation)
        observation, reward, *_ = env.step(action)
        expected, other, *_ = reference.step(action)
        np.testing.assert_array_equal(reward, other)
    shapes = {name: feature.shape for name, feature in env_to_policy_features(config).items()}
    assert shapes == {"action": (4,), "observation.state": (11,), "observation.environment_state": (21,)}
    assert config.fps == 25


def test_an_episode_is_a_success_by_its_end():
    """LeRobot counts any step's; some here are at the goal before."""
    _, env = made(8, task="reach")
    policy = load_policy(ROOT / "assets" / "policies" / "reach.npz")
    observation, _ = env.reset(seed=list(range(8)))
    rewards, successes, ends = [], [], []
    for step in range(env.call("_max_episode_steps")[0]):
        away = step > 30 and step % 2  # the second half of the environments leaves the goal at last
        action = policy(observation["environment_state"])
        action[4:] = 1.0 if away else action[4:]
        observation, reward, _, truncated, info = env.step(action)
        rewards, successes, ends = [*rewards, reward], [*successes, info["is_success"]], [*ends, truncated]
    assert (np.array(rewards[:-1]) == 0.0).any(axis=0).all()
    assert not np.any(successes[:-1])
    assert not np.any(ends[:-1])
    assert np.all(ends[-1])
    np.testing.assert_array_equal(successes[-1], rewards[-1] == 0.0)
    assert successes[-1][:4].all()
    assert not successes[-1][4:].all()


def test_pictures_are_those_of_the_cameras():
    config, env = made(2, task="push", cameras="side, front", picture_size=32)
    observation, _ = env.reset(seed=[1, 2])
    single = gymnasium.make("hgail_envs/FetchPush-v0", cameras=["front", "side"], picture_size=32)
    for index, seed in enumerate((1, 2)):
        pictures = single.reset(seed=seed)[0]["pixels"]
        np.testing.assert_array_equal(observation["pixels"]["front"][index], pictures[0])
        np.testing.assert_array_equal(observation["pixels"]["side"][index], pictures[1])
    assert env.observation_space.contains(observation)
    shapes = {name: feature.shape for name, feature in env_to_policy_features(config).items()}
    images = {f"observation.images.{camera}": (3, 32, 32) for camera in ("side", "front")}
    assert shapes == {"action": (4,), "observation.state": (10,), **images}


def test_a_target_that_is_seen_is_in_no_number():
    pictures, numbers = {}, {}
    for target in ("given", "seen"):
        _, env = made(4, task="push", cameras="front", picture_size=64, target=target)
        observation, _ = env.reset(seed=[1, 2, 3, 4])
        pictures[target], numbers[target] = observation["pixels"]["front"], observation["agent_pos"]
    np.testing.assert_array_equal(numbers["seen"], numbers["given"][:, :-4])
    assert (pictures["seen"] != pictures["given"]).any()


def test_lerobot_is_given_what_it_asks_for():
    _, env = made(2, task="pick-and-place")
    env.reset(seed=[0, 1])
    assert env.call("task_description") == ("Grasp the cube and bring it to the target.",) * 2
    assert env.get_attr("task") == ("pick-and-place",) * 2
    assert env.unwrapped.metadata["render_fps"] == 25
    (picture,), (first, second) = env.call("render"), env.render()
    np.testing.assert_array_equal(picture, first)
    assert (first != second).any()
    assert (picture.shape, picture.dtype) == ((480, 640, 3), np.uint8)
    assert {task for task in hgail_envs.TASKS if sentence(task) == task} == {"point"}


@pytest.mark.parametrize(
    ("option", "line"),
    [
        ("--env.task=poke", "unknown task 'poke'; choose from point, reach"),
        ("--env.robot=hal", "robot is 'hal'; choose from"),
        ("--env.cameras=behind", "has no camera 'behind'; it has"),
        ("--env.target=seen", "no camera is named; choose from front"),
        ("--env.picture_size=4 --env.cameras=front", "the size of a picture is 4"),
        ("--env.task=point", "the task point has no scene that LeRobot could film"),
        ("--env.fps=10", "fps is 10; pick-and-place has 25 steps per second"),
        ("--env.picture_size=64", "picture_size is 64, and there are no cameras; name some"),
    ],
)
def test_bad_options_are_one_line(option, line):
    command = "from lerobot.scripts.lerobot_eval import main; main()"
    words = ["--env.discover_packages_path=hgail_jax.lerobot", "--env.type=hgail", *option.split()]
    ended = subprocess.run([sys.executable, "-c", command, *words], capture_output=True, text=True, cwd=ROOT)
    assert ended.returncode != 0
    assert line in ended.stderr.splitlines()[-1]
    assert "Traceback" not in ended.stderr

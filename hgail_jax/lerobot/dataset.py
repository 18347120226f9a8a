"""Episodes as a `LeRobotDataset`, and one of a task's shape as demonstrations."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import datasets
import jax.numpy as jnp
import numpy as np
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.utils import CompatibilityError
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from hgail_envs import GoalEnv
from hgail_envs.layout import Layout
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.parallel import render
from hgail_jax.io.demonstrations import Demonstrations
from hgail_jax.io.files import replace_path, write_json
from hgail_jax.lerobot.environment import OBSERVATION, sentence, state_numbers
from hgail_jax.rollout import Trajectory

# LeRobot's default, AV1, is slow to start, once for each short episode; a low crf, for small pictures lose much.
_FILM = RGBEncoderConfig(vcodec="h264", crf=18)
_FILM_FILE = 1  # MB: for each episode that LeRobot appends to a file, it copies all of it
_DECODER = "pyav"  # LeRobot's default, torchcodec, is reported in fifty lines where FFmpeg is missing
_REWARD, _SUCCESS, _DONE = "next.reward", "next.success", "next.done"


def write_dataset(
    folder: Path,
    task: str,
    env: GoalEnv,
    trajectory: Trajectory,
    episodes: np.ndarray,
    made_by: dict[str, Any],
    report: Callable[[int], None],
) -> None:
    """Writes episodes of a roll-out, by their places in it, as a dataset with what LeRobot's environment shows.

    A frame has the state, the task's observation or else pictures, the action, and of the state that follows whether it
    is the goal (`next.success`), its reward, and whether it is the last. The pictures of a `CameraEnv` are rendered
    from what the roll-out noted, see `hgail_jax.play.recording.successes`. The provenance `made_by` becomes
    `meta/made_by.json`. The folder gets its name once it is whole. How many episodes are written is reported.
    """
    datasets.disable_progress_bars()
    av.logging.set_libav_level(av.logging.ERROR)
    with replace_path(folder) as partial:
        _write(partial, f"hgail/{folder.name}", task, env, trajectory, episodes, report)
        write_json(partial / "meta" / "made_by.json", made_by)


def _write(
    folder: Path,
    repository: str,
    task: str,
    env: GoalEnv,
    trajectory: Trajectory,
    episodes: np.ndarray,
    report: Callable[[int], None],
) -> None:
    observation = np.asarray(trajectory.observation(env)[:-1], np.float32)
    action, reward = np.clip(np.asarray(trajectory.action), -1.0, 1.0), np.asarray(trajectory.reward)
    camera = env if isinstance(env, CameraEnv) else None
    dataset = LeRobotDataset.create(
        repo_id=repository,
        fps=round(1 / env.control_period),
        features=_features(env),
        root=folder,
        robot_type=None if env.robot is None else env.robot.name,
        rgb_encoder=_FILM,
        video_files_size_in_mb=_FILM_FILE,
        streaming_encoding=camera is not None,
        encoder_queue_maxsize=len(observation) + 1,  # an episode and its end: from a full queue LeRobot drops frames
        video_backend=_DECODER,
    )
    try:
        noted = np.moveaxis(np.asarray(trajectory.noted), 0, 1)[episodes]
        pictures = render(camera.pictures, noted) if camera else [None] * len(episodes)
        said = sentence(task)
        for episode, shown in zip(episodes, pictures, strict=True):
            seen, rewards = observation[:, episode], reward[:, episode, None]
            columns = {OBS_STATE: seen[:, state_numbers(env)], ACTION: action[:, episode]}
            columns |= {
                _REWARD: rewards,
                _SUCCESS: rewards == 0.0,
                _DONE: np.arange(len(seen))[:, None] == len(seen) - 1,
            }
            columns |= {OBS_ENV_STATE: seen} if shown is None else {}
            columns |= {} if shown is None else dict(zip(_images(env), np.moveaxis(shown, 1, 0), strict=True))
            for step in range(len(seen)):
                dataset.add_frame({name: values[step] for name, values in columns.items()} | {"task": said})
            dataset.save_episode()
            report(dataset.num_episodes)
    finally:  # LeRobot would do it whenever the object is collected, in a folder that is removed by then
        dataset.finalize()


def _images(env: Any) -> list[str]:
    return [f"{OBS_IMAGES}.{camera}" for camera in env.pictures.cameras]


def _features(env: GoalEnv) -> dict[str, dict[str, Any]]:
    task = env.task if isinstance(env, CameraEnv) else env
    names = _titles(task.seen_layout or task.features_layout) + _titles(task.goal_layout)

    def numbers(names: list[str]) -> dict[str, Any]:
        return {"dtype": "float32", "shape": (len(names),), "names": names}

    seen = {OBS_STATE: numbers([names[place] for place in state_numbers(env)])}
    if isinstance(env, CameraEnv):
        axes = ["height", "width", "channels"]
        seen |= {name: {"dtype": "video", "shape": env.pictures.shape[1:], "names": axes} for name in _images(env)}
    else:
        seen[OBS_ENV_STATE] = numbers(names)
    after = {_REWARD: "float32", _SUCCESS: "bool", _DONE: "bool"}
    flags = {name: {"dtype": dtype, "shape": (1,), "names": None} for name, dtype in after.items()}
    return seen | {ACTION: numbers(_titles(env.action_layout))} | flags


def _titles(layout: Layout) -> list[str]:
    return [number.title for number in layout.numbers]


def read_dataset(folder: Path, task: str, env: GoalEnv) -> Demonstrations:
    """Reads a dataset with the observations and actions of a task, whoever wrote it, as demonstrations.

    Its episodes may differ in length, so that they become one; nothing that trains looks at an episode's end.

    Raises:
      ValueError: the dataset is not whole, is of another version of LeRobot, or has other features than the task.
    """
    # LeRobot would ask the Hub for what is missing; its older formats have files of the names episodes*.jsonl.
    if not (folder / "data").is_dir() or not any((folder / "meta").glob("episodes*")):
        raise ValueError(f"{folder} was not written to its end: it lacks data or meta/episodes")
    try:
        dataset = LeRobotDataset(f"hgail/{folder.name}", root=folder, video_backend=_DECODER)
    except (CompatibilityError, NotImplementedError) as error:  # the latter for the oldest
        raise ValueError(f"{folder} is of another version of LeRobot, which this one cannot read") from error
    # Without its prefix where LeRobot itself recorded its environment.
    observed = OBSERVATION if OBSERVATION in dataset.features else OBS_ENV_STATE
    for name, size in ((observed, env.observation_size), (ACTION, env.action_size)):
        if name not in dataset.features:
            raise ValueError(f"{folder} has no {name}; a dataset with pictures is no demonstration")
        shape = tuple(dataset.features[name]["shape"])
        if shape != (size,):
            raise ValueError(f"{folder} has {name} of the shape {shape}; {task} has {size} numbers")
    columns = dataset.hf_dataset.with_format("numpy")
    observation, action = (np.asarray(columns[name][:], np.float32)[None] for name in (observed, ACTION))
    features, goal = np.split(observation, [env.feature_size], axis=-1)
    if not np.array_equal(env.goal_observation(jnp.asarray(features), jnp.asarray(goal)), observation):
        raise ValueError(f"observations of {task} are not its features and its goal, and are no demonstrations")
    nothing = np.zeros(1, np.float32)
    return Demonstrations(task, features, goal, action, nothing + 1.0, nothing, nothing, {"controller": str(folder)})

"""Episodes as a `LeRobotDataset`, and one of a task's shape as demonstrations."""

import contextlib
import io
import tempfile
from collections.abc import Callable
from itertools import repeat
from pathlib import Path
from typing import Any

import av
import datasets
import jax.numpy as jnp
import numpy as np
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset, aggregate_datasets
from lerobot.datasets.utils import CompatibilityError
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from hgail_envs import GoalEnv
from hgail_envs.layout import Layout
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.parallel import use_pictures
from hgail_jax.io.demonstrations import Demonstrations
from hgail_jax.io.files import replace_path, write_json
from hgail_jax.lerobot.environment import OBSERVATION, sentence, state_numbers
from hgail_jax.rollout import Trajectory

# LeRobot's default, AV1, is slow to start, once for each short episode. A low crf, for small pictures lose much; with
# it the fastest preset loses no more than the others do, and its files are up to twice as large.
_FILM = RGBEncoderConfig(vcodec="h264", crf=18, preset="ultrafast")
_FILM_FILE = 1  # MB: for each episode that LeRobot appends to a file, it copies all of it
_PART = 10  # episodes that one process writes at a time
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
    made: dict[str, Any] = {
        "repo_id": f"hgail/{folder.name}",
        "fps": round(1 / env.control_period),
        "features": _features(env),
        "robot_type": None if env.robot is None else Path(env.robot.name).stem,  # a name, or a description's file
    }
    columns = _columns(env, trajectory, episodes)
    with replace_path(folder) as partial:
        if isinstance(env, CameraEnv):
            noted = np.moveaxis(np.asarray(trajectory.noted), 0, 1)[episodes]
            _write_films(partial, made, sentence(task), columns, env, noted, report)
        else:
            _write_episodes(None, partial, made, sentence(task), columns)
            report(len(episodes))
        write_json(partial / "meta" / "made_by.json", made_by)


def _columns(env: GoalEnv, trajectory: Trajectory, episodes: np.ndarray) -> list[dict[str, np.ndarray]]:
    """Returns the numbers of each episode by the names of their features, `[steps, numbers]` each."""
    seen = np.asarray(trajectory.observation(env)[:-1], np.float32)[:, episodes]
    reward = np.asarray(trajectory.reward)[:, episodes, None]
    columns = {
        OBS_STATE: seen[..., state_numbers(env)],
        ACTION: np.clip(np.asarray(trajectory.action)[:, episodes], -1.0, 1.0),
        _REWARD: reward,
        _SUCCESS: reward == 0.0,
        _DONE: np.broadcast_to(np.arange(len(seen))[:, None, None] == len(seen) - 1, reward.shape),
    }
    columns |= {} if isinstance(env, CameraEnv) else {OBS_ENV_STATE: seen}
    return [{name: values[:, place] for name, values in columns.items()} for place in range(len(episodes))]


def _write_films(
    folder: Path,
    made: dict[str, Any],
    words: str,
    columns: list[dict[str, np.ndarray]],
    env: CameraEnv,
    noted: np.ndarray,
    report: Callable[[int], None],
) -> None:
    """Writes a dataset with pictures: processes write parts of it, for LeRobot writes one episode after another."""
    places = [slice(first, first + _PART) for first in range(0, len(columns), _PART)]
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as temporary:
        parts = [Path(temporary) / str(part) for part in range(len(places))]
        arguments = parts, repeat(made, len(parts)), repeat(words, len(parts)), [columns[place] for place in places]
        written = 0
        for episodes in use_pictures(env.pictures, [noted[place] for place in places], _write_episodes, *arguments):
            written += episodes
            report(written)
        with contextlib.redirect_stderr(io.StringIO()):  # its progress bars
            aggregate_datasets([made["repo_id"]] * len(parts), made["repo_id"], parts, folder, concatenate_videos=False)


def _write_episodes(
    pictures: np.ndarray | None, folder: Path, made: dict[str, Any], words: str, columns: list[dict[str, np.ndarray]]
) -> int:
    """Writes episodes, with their pictures `[episodes, steps, cameras, size, size, 3]`, and returns how many."""
    datasets.disable_progress_bars()
    av.logging.set_libav_level(av.logging.ERROR)
    steps = len(columns[0][ACTION])
    dataset = LeRobotDataset.create(
        root=folder,
        **made,
        rgb_encoder=_FILM,
        video_files_size_in_mb=_FILM_FILE,
        streaming_encoding=pictures is not None,
        encoder_queue_maxsize=steps + 1,  # an episode and its end: from a full queue LeRobot drops frames
        encoder_threads=1,
        video_backend=_DECODER,
    )
    try:
        images = [name for name in made["features"] if name.startswith(OBS_IMAGES)]
        for episode, numbers in enumerate(columns):
            shown = {} if pictures is None else dict(zip(images, np.moveaxis(pictures[episode], 1, 0), strict=True))
            for step in range(steps):
                dataset.add_frame({name: values[step] for name, values in (numbers | shown).items()} | {"task": words})
            dataset.save_episode()
    finally:  # LeRobot would do it whenever the object is collected, in a folder that is removed by then
        dataset.finalize()
    return len(columns)


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

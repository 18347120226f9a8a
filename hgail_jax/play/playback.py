"""Plays a policy on a task that has a scene: as a film, or in MuJoCo's viewer."""

import contextlib
import os
import sys
import time
import warnings
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import jax
import jax.numpy as jnp
import numpy as np

from hgail_envs import GoalEnv, State
from hgail_envs.scenes import free_camera, open_scene, pose
from hgail_envs.vision.rendering import RenderingError, open_renderer
from hgail_jax.io.files import replace_path
from hgail_jax.policy import MeanPolicy
from hgail_jax.terminal import StatusLine

_SIZE = (480, 640)  # height, width
_HOLD = 10  # frames that the last pose of an episode stands still
_FADE = 8  # frames from an episode's end to the start of the next
_EDGE = 8  # pixels around the last pose
_EDGE_COLOURS = {True: (0, 158, 115), False: (213, 94, 0)}  # green and red that the colour-blind tell apart


class Playback:
    """Episodes of a policy, posed in the task's scene frame by frame.

    Args:
      env: the task.
      policy: the policy.
      seed: of the episodes.

    Raises:
      ValueError: the task has no scene.

    """

    def __init__(self, env: GoalEnv, policy: MeanPolicy, seed: int) -> None:
        self.model, self.data = open_scene(env)
        self.outcomes: list[bool] = []
        """Whether each episode so far was a success."""
        self.ended = False
        """True while an episode's last pose is held."""
        self._env, self._policy, self._seed = env, policy, seed

    def play(self, episodes: int) -> Iterator[bool]:
        """Poses `data` for each frame of some episodes, lift test included, with the target's site at the goal.

        Yields whether the frame is the first of an episode.
        """
        reset, step, outcome = jax.jit(self._env.reset), jax.jit(self._env.step), jax.jit(self._env.outcome)
        for key in jax.random.split(jax.random.key(self._seed), episodes):
            self.ended = False
            state = end = reset(key)
            action: np.ndarray | jax.Array = np.zeros(self._env.action_size, np.float32)
            for frame in range(self._env.episode_length + self._env.lift_test_steps):
                self._pose(state)
                yield frame == 0
                acts = frame < self._env.episode_length
                action = (
                    self._policy(np.asarray(state.obs)) if acts else self._env.lift_test_action(jnp.asarray(action))
                )
                state = step(state, action)
                end = state if acts else end
            self.outcomes.append(bool(outcome(end, state).success))
            self.ended = True
            self._pose(state)
            for _ in range(_HOLD):
                yield False

    def _pose(self, state: State) -> None:
        goal, qpos = np.asarray(state.info["desired_goal"]), np.asarray(state.pipeline_state.qpos)
        pose(self.model, self.data, qpos, goal)


def frames(playback: Playback, episodes: int, height: int, width: int, every: int = 1) -> Iterator[np.ndarray]:
    """Renders every `every`-th frame of a playback as a picture, `[height, width, 3]`, uint8.

    One episode fades into the next, so that nothing jumps.

    Raises:
      RenderingError: MuJoCo cannot render here.

    """
    camera = free_camera(playback.model)
    with open_renderer(playback.model, height, width) as renderer:
        picture: np.ndarray | None = None
        for index, first in enumerate(playback.play(episodes)):
            if index % every and not first:
                continue
            renderer.update_scene(playback.data, camera)
            before, picture = picture, renderer.render()
            if first and before is not None:
                for fraction in np.linspace(0.0, 1.0, _FADE // every + 2)[1:-1]:
                    yield ((1.0 - fraction) * before + fraction * picture).astype(np.uint8)
            yield picture


def film(path: Path, env: GoalEnv, policy: MeanPolicy, episodes: int = 5, seed: int = 0) -> list[bool]:
    """Writes a film of a few episodes in real time, in one of `FORMATS`; returns whether each succeeded.

    The target is a red ball, or the body that the task names. The last pose of an episode has a green edge where it
    succeeded, a red one where it did not.

    Raises:
      RenderingError: MuJoCo cannot render here.

    """
    playback = Playback(env, policy, seed)
    pictures = episodes * (env.episode_length + env.lift_test_steps + _HOLD) + (episodes - 1) * _FADE
    with StatusLine("compiling and filming") as line, open_film(path, env.control_period) as append:
        for number, frame in enumerate(frames(playback, episodes, *_SIZE), start=1):
            append(_edged(frame, playback.outcomes[-1]) if playback.ended else frame)
            line.show(f"filming, picture {number} of {pictures}", log=False)
        line.show(f"writing {path.name}", log=False)
    return playback.outcomes


def _edged(picture: np.ndarray, success: bool) -> np.ndarray:
    edged = np.full_like(picture, _EDGE_COLOURS[success])
    inside = slice(_EDGE, -_EDGE)
    edged[inside, inside] = picture[inside, inside]
    return edged


def show(env: GoalEnv, policy: MeanPolicy, episodes: int, seed: int) -> list[bool]:
    """Plays episodes in MuJoCo's viewer, in real time or as fast as the simulation goes, until it is closed.

    Raises:
      RenderingError: there is no display that answers.

    """
    _check_display()
    import mujoco.viewer  # needs a display

    playback = Playback(env, policy, seed)
    with mujoco.viewer.launch_passive(playback.model, playback.data) as viewer:
        for _ in playback.play(episodes):
            started = time.perf_counter()
            if not viewer.is_running():
                break
            viewer.sync()
            time.sleep(max(0.0, env.control_period - (time.perf_counter() - started)))
    return playback.outcomes


def _check_display() -> None:
    """Refuses a display that does not answer; MuJoCo's viewer would end the process."""
    import glfw  # comes with MuJoCo

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if sys.platform == "linux" and not glfw.init():
            display = os.environ.get("DISPLAY", "")
            raise RenderingError(f"no window opens on DISPLAY={display}; --out writes a film, --web serves a page")


Append = Callable[[np.ndarray], None]
"""Adds the next picture, `[height, width, 3]`, uint8."""

# One palette for all pictures of a GIF: palettes per picture would flicker.
_PALETTE = "split[a][b];[a]palettegen[p];[b][p]paletteuse=dither=none"
_ENCODERS: dict[str, dict[str, Any]] = {
    ".mp4": {"quality": 8},
    ".gif": {"codec": "gif", "pix_fmt_out": "pal8", "quality": None, "output_params": ["-lavfi", _PALETTE]},
    ".webp": {"codec": "libwebp", "quality": None, "output_params": ["-loop", "0", "-quality", "80", "-f", "webp"]},
}
FORMATS = tuple(_ENCODERS)
"""Endings of a film's name."""


def check_film(path: Path) -> None:
    """Refuses a name under which no new film can be written.

    Raises:
      ValueError: it is no such name.

    """
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"{path} is not the name of a film; it must end in {', '.join(FORMATS)}")
    if path.exists() or path.is_symlink():
        raise ValueError(f"{path} exists already; name another file, or remove it")
    if not path.parent.is_dir():
        raise ValueError(f"there is no folder {path.parent} to write {path.name} into")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise ValueError(f"the folder {path.parent} cannot be written to")


@contextlib.contextmanager
def open_film(path: Path, frame_period: float) -> Iterator[Append]:
    """Opens a film, which takes its name once it is whole; a failure leaves no file.

    Args:
      path: ends in one of `FORMATS`.
      frame_period: seconds between two pictures.

    """
    encoders: list[Generator[None, np.ndarray | None, None]] = []

    def append(frame: np.ndarray) -> None:
        if not encoders:  # FFmpeg learns the size from the first picture
            options = _ENCODERS[path.suffix.lower()]
            output = f"file:{temporary}"  # without which FFmpeg reads a:b as b by the protocol a
            size = frame.shape[1::-1]
            encoders.append(imageio_ffmpeg.write_frames(output, size, fps=1.0 / frame_period, **options))
            encoders[0].send(None)
        encoders[0].send(np.ascontiguousarray(frame))

    with replace_path(path) as temporary:
        try:
            yield append
        finally:
            for encoder in encoders:
                encoder.close()

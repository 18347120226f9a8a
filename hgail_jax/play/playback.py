"""Plays a policy on a task that has a scene: as a film, or in MuJoCo's viewer.

A `RenderingError` says that MuJoCo cannot render here, or that no display answers.
"""

import contextlib
import os
import sys
import time
import warnings
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from hgail_envs import GoalEnv
from hgail_envs.scenes import free_camera
from hgail_envs.vision.rendering import RenderingError, open_renderer
from hgail_jax.io.files import replace_path
from hgail_jax.play.session import Actor, Phase, Session
from hgail_jax.terminal import StatusLine

_SIZE = (480, 640)  # height, width
_HOLD = 15  # frames that the last pose of an episode stands still
_EDGE = 8  # pixels around the last pose
_INSET = 128  # pixels, edge of what a policy sees, twice as large as it is by default
_TEXT_SIZE, _TEXT_COLOUR = 20, (35, 55, 85)
_ZONE_COLOUR = (0.9, 0.1, 0.1, 0.25)  # of the ball within which a position is at the target
_EDGE_COLOURS = {True: (0, 158, 115), False: (213, 94, 0)}  # green and red that the colour-blind distinguish


def play(session: Session, episodes: int) -> Iterator[bool]:
    """Runs the session for some episodes, posed for each frame, and yields whether the frame is an episode's first.

    The last pose of an episode, whose phase is `RESTING`, is held for a few frames.
    """
    for episode in range(episodes):
        if episode:
            session.restart()
        for frame in range(session.env.episode_length + session.env.lift_test_steps):
            session.pose()
            yield frame == 0
            session.step()
        session.pose()
        for _ in range(_HOLD):
            yield False


def frames(session: Session, episodes: int, height: int, width: int, every: int = 1) -> Iterator[np.ndarray]:
    """Renders every `every`-th frame of `play` as a picture, `[height, width, 3]`, uint8."""
    camera = free_camera(session.model)
    with open_renderer(session.model, height, width) as renderer:
        for index, first in enumerate(play(session, episodes)):
            if index % every and not first:
                continue
            renderer.update_scene(session.data, camera)
            if not session.env.lift_test_steps:
                _add_ball(renderer.scene, session.target, session.env.success_threshold)
            yield renderer.render()


def _add_ball(scene: mujoco.MjvScene, position: np.ndarray, radius: float) -> None:
    """Adds the zone of success, which shows where the hand hides the target."""
    ball, size, no_rotation = scene.geoms[scene.ngeom], np.full(3, radius), np.eye(3).ravel()
    mujoco.mjv_initGeom(ball, mujoco.mjtGeom.mjGEOM_SPHERE, size, position, no_rotation, np.array(_ZONE_COLOUR))
    scene.ngeom += 1


def caption(session: Session) -> str:
    """Returns the time and the distance from the target, or the outcome of an episode that is over."""
    status = session.status
    if status.phase is Phase.RESTING:
        return "success" if status.success else "missed"
    test = "test, " if status.phase is Phase.LIFT_TEST else ""
    return f"{test}{session.time:.1f} s, {100.0 * status.distance:.1f} cm"


def film(path: Path, env: GoalEnv, policy: Actor, episodes: int = 5, seed: int = 0) -> list[bool]:
    """Writes a film of a few episodes in real time, in one of `FORMATS`; returns whether each succeeded.

    The target is a red ball, or the body that the task names. Each picture has a `caption`; the last pose of an episode
    has a green edge where it succeeded, a red one where it did not. What a policy with cameras sees is in the lower
    left corner.
    """
    pictures = episodes * (env.episode_length + env.lift_test_steps + _HOLD)
    with StatusLine("compiling and filming") as line, open_film(path, env.control_period) as append:
        session = Session(env, policy, seed)
        for number, frame in enumerate(frames(session, episodes, *_SIZE), start=1):
            picture = _with_inset(_captioned(frame, caption(session)), session.seen)
            append(_edged(picture, session.outcomes[-1]) if session.phase is Phase.RESTING else picture)
            line.show(f"filming, picture {number} of {pictures}", log=False)
        line.show(f"writing {path.name}", log=False)
    return session.outcomes


def _captioned(picture: np.ndarray, text: str) -> np.ndarray:
    image = Image.fromarray(picture)
    at = (_EDGE + 6, _EDGE + 2)
    ImageDraw.Draw(image).text(at, text, _TEXT_COLOUR, ImageFont.load_default(_TEXT_SIZE))
    return np.asarray(image)


def _with_inset(picture: np.ndarray, seen: np.ndarray | None) -> np.ndarray:
    """Returns a picture, `[height, width, 3]`, with those that a policy sees, if any, in its lower left corner."""
    if seen is None:
        return picture
    image = Image.fromarray(picture)
    for number, small in enumerate(reversed(seen)):
        inset = Image.new("RGB", (_INSET + 2, _INSET + 2), "white")
        inset.paste(Image.fromarray(small).resize((_INSET, _INSET), Image.Resampling.NEAREST), (1, 1))
        image.paste(inset, (_EDGE, image.height - _EDGE - (number + 1) * inset.height))
    return np.asarray(image)


def _edged(picture: np.ndarray, success: bool) -> np.ndarray:
    edged = np.full_like(picture, _EDGE_COLOURS[success])
    inside = slice(_EDGE, -_EDGE)
    edged[inside, inside] = picture[inside, inside]
    return edged


def show(env: GoalEnv, policy: Actor, episodes: int, seed: int) -> list[bool]:
    """Plays episodes in MuJoCo's viewer, in real time or as fast as the simulation goes, until it is closed."""
    _check_display()
    import mujoco.viewer  # needs a display

    session = Session(env, policy, seed)
    with mujoco.viewer.launch_passive(session.model, session.data) as viewer:
        for _ in play(session, episodes):
            started = time.perf_counter()
            if not viewer.is_running():
                break
            viewer.sync()
            time.sleep(max(0.0, env.control_period - (time.perf_counter() - started)))
    return session.outcomes


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


@contextlib.contextmanager
def open_film(path: Path, frame_period: float) -> Iterator[Append]:
    """Opens a film in one of `FORMATS`, and its folder; `frame_period` is in seconds. A failure leaves no file."""
    encoders: list[Generator[None, np.ndarray | None, None]] = []

    def append(frame: np.ndarray) -> None:
        if not encoders:  # FFmpeg learns the size from the first picture
            options = _ENCODERS[path.suffix.lower()]
            output = f"file:{temporary}"  # without which FFmpeg reads a:b as b by the protocol a
            size = frame.shape[1::-1]
            encoders.append(imageio_ffmpeg.write_frames(output, size, fps=1.0 / frame_period, **options))
            encoders[0].send(None)
        encoders[0].send(np.ascontiguousarray(frame))

    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_path(path) as temporary:
        try:
            yield append
        finally:
            for encoder in encoders:
                encoder.close()

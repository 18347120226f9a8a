"""Pictures of the tasks for the pages: `python -m experiments.film` writes `FILM` and `STARTS`.

`FILM` has the policies that come with the package at work, side by side; `STARTS` the tasks' starts.
"""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import hgail_envs
from hgail_envs import GoalEnv
from hgail_envs.randomized import randomize
from hgail_envs.scenes import SceneView, assets_directory
from hgail_jax.cli.command_line import one_line_errors, prepare_process
from hgail_jax.io.policy import load_policy
from hgail_jax.play.playback import caption, frames, open_film
from hgail_jax.play.session import Phase, Session
from hgail_jax.policy import MeanPolicy

_IMAGES = Path(__file__).parent.parent / "docs" / "images"
FILM, STARTS = _IMAGES / "policies.webp", _IMAGES / "tasks.webp"
"""Replaced by each run."""

_PANELS = {
    "grasp": "grasp",
    "push": "push",
    "pick and place": "pick-and-place",
    "slide": "slide",
    "stack": "stack",
    "tower": "tower",
}
"""Titles, and the policies below them; a multiple of `_COLUMNS`, so that no panel stays empty."""
_SECONDS = 10.0
_EVERY = 2  # of the frames is shown
_COLUMNS = 3
_SIZE = (240, 300)  # height and width of a task's picture, pixels
_SCALE = 2  # rendered so many times larger, then made smaller, which smooths edges
_BAND, _GAP = 30, 3  # height of the title above a picture, and the white around a panel
_TEXT_SIZE, _CAPTION_SIZE, _TEXT_COLOUR, _BAND_COLOUR = 18, 14, (35, 55, 85), (225, 231, 240)
_SUCCESS_COLOUR, _SUCCESS_BORDER = (30, 142, 78), 4
_START, _START_COLUMNS = (300, 225), 4  # width and height of a start's picture, pixels; pictures in a row


def main() -> None:
    """Films all `_PANELS`, six at once, and draws the starts."""
    draw_starts()
    loaded = {title: _load(name) for title, name in _PANELS.items()}
    period = max(env.control_period for env, _ in loaded.values()) * _EVERY
    panels = [_panels(title, Session(env, policy)) for title, (env, policy) in loaded.items()]
    with open_film(FILM, period) as append:
        for together in itertools.islice(zip(*panels, strict=True), round(_SECONDS / period)):
            append(_tile(together))
    print(f"{', '.join(_PANELS)} -> {FILM}, {FILM.stat().st_size / 1e6:.1f} MB")


def draw_starts() -> None:
    """Draws the start of an episode of each task that has a scene, a red ball at the target."""
    tasks = [task for task in hgail_envs.TASKS if hgail_envs.find_class(task).scene]
    width, height = _START
    rows = math.ceil(len(tasks) / _START_COLUMNS)
    montage = Image.new("RGB", (_START_COLUMNS * width, rows * (height + 24)), "white")
    font = ImageFont.load_default(16)
    for index, task in enumerate(tasks):
        env = hgail_envs.make(task, impl="c")
        state = jax.jit(env.reset)(jax.random.key(3))
        view = SceneView(env, "rgb_array")
        picture = view.picture(np.asarray(state.pipeline_state.qpos), np.asarray(state.info["desired_goal"]))
        view.close()
        corner = (index % _START_COLUMNS * width, index // _START_COLUMNS * (height + 24))
        montage.paste(Image.fromarray(picture).resize(_START, Image.Resampling.LANCZOS), (corner[0], corner[1] + 24))
        ImageDraw.Draw(montage).text((corner[0] + 6, corner[1] + 2), task, "black", font)
    montage.save(STARTS, quality=80)


def _load(name: str) -> tuple[GoalEnv, MeanPolicy]:
    """Returns a policy of the package and its task, randomised as it was in the training."""
    policy = load_policy(assets_directory() / "policies" / f"{name}.npz")
    return randomize(hgail_envs.make(policy.task, **policy.task_options), policy.randomization), policy


def _panels(title: str, session: Session) -> Iterator[np.ndarray]:
    """Yields the pictures of a session below its title, `[height, width, 3]`, without end."""
    height, width = _SIZE
    for frame in frames(session, math.ceil(_SECONDS), _SCALE * height, _SCALE * width, _EVERY):
        picture = Image.fromarray(frame).resize((width, height), Image.Resampling.LANCZOS)
        success = session.phase is Phase.RESTING and session.outcomes[-1]
        yield _titled(title, caption(session), picture, success)


def _titled(title: str, text: str, picture: Image.Image, success: bool) -> np.ndarray:
    """Returns a picture below a band with title and text, green and with a tick where the episode is a success."""
    width, height = picture.size
    panel = Image.new("RGB", (width, _BAND + height), _SUCCESS_COLOUR if success else _BAND_COLOUR)
    panel.paste(picture, (0, _BAND))
    draw = ImageDraw.Draw(panel)
    colour = (255, 255, 255) if success else _TEXT_COLOUR
    draw.text((10, _BAND / 2), title, colour, ImageFont.load_default(_TEXT_SIZE), anchor="lm")
    if success:
        draw.line([(width - 28, 15), (width - 22, 21), (width - 10, 8)], colour, width=3, joint="curve")
        draw.rectangle((0, 0, width - 1, _BAND + height - 1), outline=_SUCCESS_COLOUR, width=_SUCCESS_BORDER)
    else:
        draw.text((width - 10, _BAND / 2), text, colour, ImageFont.load_default(_CAPTION_SIZE), anchor="rm")
    return np.asarray(panel)


def _tile(panels: tuple[np.ndarray, ...]) -> np.ndarray:
    """Lays panels out in rows of `_COLUMNS`, on white."""
    framed = [np.pad(panel, ((_GAP, _GAP), (_GAP, _GAP), (0, 0)), constant_values=255) for panel in panels]
    rows = [framed[first : first + _COLUMNS] for first in range(0, len(framed), _COLUMNS)]
    return np.vstack([np.hstack(row) for row in rows])


if __name__ == "__main__":
    with one_line_errors("film"):
        prepare_process()
        main()

"""Films the policies that come with the package side by side: `python -m experiments.film` writes `FILM`."""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import hgail_envs
from hgail_envs.scenes import assets_directory
from hgail_jax.cli.command_line import one_line_errors, prepare_process
from hgail_jax.io.policy import load_policy
from hgail_jax.play.film import open_film
from hgail_jax.play.playback import Playback, frames

FILM = Path(__file__).parent.parent / "docs" / "images" / "policies.webp"
"""What is written, and replaced."""

_SECONDS = 10.0
_EVERY = 2  # of the playback's frames is shown
_COLUMNS = 3
_SIZE = (300, 340)  # height and width of a task's picture, pixels
_SCALE = 2  # rendered so many times larger, then made smaller, which smooths edges
_TEXT_SIZE, _TEXT_PLACE, _TEXT_COLOUR = 20, (12, 8), (35, 55, 85)


def main() -> None:
    """Films all tasks that have a scene and a policy in the package."""
    policies = assets_directory() / "policies"
    shown = [task for task in hgail_envs.TASKS if hgail_envs.find_class(task).scene]
    tasks = [task for task in shown if (policies / f"{task}.npz").exists()]
    pictures = [_pictures(task, policies / f"{task}.npz") for task in tasks]
    period = max(hgail_envs.make(task).control_period for task in tasks) * _EVERY
    FILM.parent.mkdir(parents=True, exist_ok=True)
    with open_film(FILM, period) as append:
        for together in itertools.islice(zip(*pictures, strict=True), round(_SECONDS / period)):
            append(_tile(together))
    print(f"{', '.join(tasks)} -> {FILM}, {FILM.stat().st_size / 1e6:.1f} MB")


def _pictures(task: str, policy: Path) -> Iterator[np.ndarray]:
    """Yields the pictures of a task, `[height, width, 3]`, for as long as they are wanted."""
    playback = Playback(hgail_envs.make(task), load_policy(policy), seed=0)
    height, width = _SIZE
    font = ImageFont.load_default(_TEXT_SIZE)
    for frame in frames(playback, math.ceil(_SECONDS), _SCALE * height, _SCALE * width, _EVERY):
        picture = Image.fromarray(frame).resize((width, height), Image.Resampling.LANCZOS)
        ImageDraw.Draw(picture).text(_TEXT_PLACE, task, _TEXT_COLOUR, font)
        yield np.asarray(picture)


def _tile(pictures: tuple[np.ndarray, ...]) -> np.ndarray:
    """Lays pictures out in rows of `_COLUMNS`, on white."""
    height, width = _SIZE
    columns = min(_COLUMNS, len(pictures))
    sheet = np.full((math.ceil(len(pictures) / columns) * height, columns * width, 3), 255, np.uint8)
    for index, picture in enumerate(pictures):
        top, left = index // columns * height, index % columns * width
        sheet[top : top + height, left : left + width] = picture
    return sheet


if __name__ == "__main__":
    with one_line_errors("film"):
        prepare_process()
        main()

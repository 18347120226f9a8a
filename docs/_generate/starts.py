"""Draws the picture of the tasks' starts that `docs/tasks.md` shows: `python -m docs._generate.starts`."""

import math
from pathlib import Path

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import hgail_envs
from hgail_envs.scenes import SceneView

PICTURE = Path(__file__).parent.parent / "images" / "tasks.webp"
"""Starts of the tasks side by side."""
TASKS = ("reach", "grasp", "push", "pick-and-place", "slide", "stack", "tower")
_PANEL = (300, 225)  # width and height, pixels
_COLUMNS = 4  # of panels


def main() -> None:
    """Draws the start of an episode of each task, a red ball at the target."""
    width, height = _PANEL
    rows = math.ceil(len(TASKS) / _COLUMNS)
    montage = Image.new("RGB", (_COLUMNS * width, rows * (height + 24)), "white")
    font = ImageFont.load_default(16)
    for index, task in enumerate(TASKS):
        env = hgail_envs.make(task, impl="c")
        state = jax.jit(env.reset)(jax.random.key(3))
        view = SceneView(env, "rgb_array")
        picture = view.picture(np.asarray(state.pipeline_state.qpos), np.asarray(state.info["desired_goal"]))
        view.close()
        corner = (index % _COLUMNS * width, index // _COLUMNS * (height + 24))
        montage.paste(Image.fromarray(picture).resize(_PANEL, Image.Resampling.LANCZOS), (corner[0], corner[1] + 24))
        ImageDraw.Draw(montage).text((corner[0] + 6, corner[1] + 2), task, "black", font)
    montage.save(PICTURE, quality=80)


if __name__ == "__main__":
    main()

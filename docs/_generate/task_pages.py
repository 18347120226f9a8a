"""Writes a section for each task from its class; `python -m docs._generate.task_pages` draws their picture."""

import inspect
import math
import re

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import hgail_envs
from docs._generate.results import ROOT, fixed, of_seeds, read_json
from docs._generate.tables import markdown
from hgail_envs.layout import Layout
from hgail_envs.quantities import describe
from hgail_envs.registry import GYMNASIUM_IDS, accepted_options, find_class

PICTURE = ROOT / "docs" / "images" / "tasks.webp"
"""Starts of the tasks side by side."""
_RUNS = {
    "reach": "reach-hgail",
    "grasp": "grasp-hgail",
    "push": "push-td3",
    "pick-and-place": "pick-and-place-td3",
    "slide": "slide-td3",
    "stack": "stack-td3",
    "tower": "tower-td3",
}
_TO_BE_LEFT = "; of a cube to be left, 0.025 m in the plane and 0.01 m in height"
_GOAL_TESTS = {"grasp": ", and held", "stack": _TO_BE_LEFT, "tower": _TO_BE_LEFT}
_NOT_ON = {"slide": ("jax",), "point": ("warp", "c")}
_ENGINES = ("warp", "c", "jax")
_PANEL = (300, 225)  # width and height, pixels
_COLUMNS = 4  # of panels


def task_page(task: str) -> str:
    """Returns the section of a task: what it is, its numbers, options, engines and shipped policies."""
    described = describe(task)
    parts = [
        _prose(task),
        _facts(task),
        "Observation, and after it the goal:",
        _numbers(described.observation, described.features.size),
        "Action, each number in [-1, 1]:",
        _numbers(described.action),
        _options(task),
    ]
    return "\n\n" + "\n\n".join(part.strip() for part in parts if part) + "\n\n"


def _prose(task: str) -> str:
    """Returns the docstring of a task's class, without arguments and references to other classes."""
    text = inspect.cleandoc(find_class(task).__doc__ or "").split("\n\nArgs:")[0]
    paragraphs = [part for part in text.split("\n\n") if not part.startswith("See `")]
    return "\n\n".join(re.sub(r" See `ObjectEnv` for\s+the meaning of a goal\.", "", part) for part in paragraphs)


def _facts(task: str) -> str:
    of_class = find_class(task)
    engines = [f"`{engine}`" for engine in _ENGINES if engine not in _NOT_ON.get(task, ())]
    rows = [
        ["Gymnasium", f"`{GYMNASIUM_IDS[task]}`"],
        ["reference", f"`{of_class.reference}`" if of_class.reference else "none"],
        ["episode", f"{of_class.episode_length} steps of {of_class.control_period:g} s"],
        ["reward", "-1 a step, 0 at the goal"],
        ["goal test", f"within {of_class.success_threshold:g} m" + _GOAL_TESTS.get(task, "")],
        ["engines", ", ".join(engines) if task != "point" else "none needed, it is all JAX"],
        ["scripted controllers", ", ".join(f"`{name}`" for name in of_class.controllers) or "none"],
        *_policies(task),
    ]
    return markdown(["", ""], rows)


def _policies(task: str) -> list[list[str]]:
    """Returns the shipped policies of a task and their measured success."""
    if task not in _RUNS:
        return [["shipped policy", "none"]]
    rows = [
        ["success of its training, eight seeds", of_seeds(read_json(f"runs/{_RUNS[task]}/summary")["success_rate"])]
    ]
    rows += [
        [
            "success of the shipped policy in the reference's environment",
            f"{fixed(row['success_rate'], 3)} of {row['episodes']} episodes",
        ]
        for row in read_json("suite/tasks")["gymnasium"]["rows"]
        if row["task"] == task
    ]
    folder = hgail_envs.scenes.assets_directory() / "policies"  # type: ignore[attr-defined]
    names = [f"`{path.name}`" for path in sorted(folder.glob(f"{task}*.npz")) if path.stem in (task, f"{task}-robust")]
    if (folder / f"{task}-robust.npz").exists():
        robust = read_json(f"runs/{task}-hgail-robust/summary")["success_rate"]["mean"]
        rows.append(["success of robust trainings, under `full` as it was then", fixed(robust, 3)])
    return [["shipped policies", ", ".join(names)], *rows]


def _numbers(layout: Layout, goal: int | None = None) -> str:
    """Returns a table of quantities; from the index `goal` on they are the goal's.

    >>> print(_numbers(describe("point").goal, 0).strip())
    | index | quantity | unit | frame |
    |---|---|---|---|
    | 0:3, the goal's 0:3 | target position | m | world |
    """
    rows, index = [], 0
    for quantity in layout:
        span = _span(index, quantity.size)
        if goal is not None and index >= goal:
            span += f", the goal's {_span(index - goal, quantity.size)}"
        rows.append([span, quantity.name, quantity.unit, quantity.frame])
        index += quantity.size
    return markdown(["index", "quantity", "unit", "frame"], rows)


def _span(first: int, size: int) -> str:
    return f"{first}:{first + size}" if size > 1 else str(first)


def _options(task: str) -> str:
    """Returns a table of a task's options, with the meaning that the docstrings of its classes give."""
    docstrings = [inspect.cleandoc(base.__doc__ or "") for base in reversed(find_class(task).__mro__)]
    meanings: dict[str, str] = {}
    for text in docstrings:
        _, _, arguments = text.partition("\n\nArgs:\n")
        for name, meaning in re.findall(r"^  (\w+): (.*?)(?=^  \w+: |^$|\Z)", arguments, re.DOTALL | re.MULTILINE):
            meanings[name] = " ".join(meaning.split())
    defaults = inspect.signature(find_class(task)).parameters
    rows = [[f"`{name}`", f"`{defaults[name].default!r}`", meanings[name]] for name in accepted_options(task)]
    return (
        "Options of `hgail_envs.make`:\n\n" + markdown(["option", "default", "meaning"], rows).strip() if rows else ""
    )


def main() -> None:
    """Draws the start of an episode of each task with a scene, a red ball at the target."""
    width, height = _PANEL
    rows = math.ceil(len(_RUNS) / _COLUMNS)
    montage = Image.new("RGB", (_COLUMNS * width, rows * (height + 24)), "white")
    font = ImageFont.load_default(16)
    for index, task in enumerate(_RUNS):
        env = hgail_envs.make(task, impl="c")
        state = jax.jit(env.reset)(jax.random.key(3))
        view = hgail_envs.scenes.SceneView(env, "rgb_array")  # type: ignore[attr-defined]
        picture = view.picture(np.asarray(state.pipeline_state.qpos), np.asarray(state.info["desired_goal"]))
        view.close()
        corner = (index % _COLUMNS * width, index // _COLUMNS * (height + 24))
        montage.paste(Image.fromarray(picture).resize(_PANEL, Image.Resampling.LANCZOS), (corner[0], corner[1] + 24))
        ImageDraw.Draw(montage).text((corner[0] + 6, corner[1] + 2), task, "black", font)
    montage.save(PICTURE, quality=80)


if __name__ == "__main__":
    main()

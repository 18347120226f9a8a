"""The paper's figures, drawn from their data."""

import csv
import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from experiments.paper.studies import FIGURES
from hgail_jax.io.files import replace_file
from hgail_jax.trainer.statistics import confidence_interval

_COLORS = [plt.colormaps["tab20"](index) for index in (*range(0, 20, 2), *range(1, 20, 2))]  # the strong ones first
_TASKS = ("reach", "grasp")  # in the paper's order; others follow
_PANELS = (
    ("success", "success rate", (-0.02, 1.02)),
    ("distance", "L1 distance at the end (m)", (0.0, None)),
)


def draw_figure(folder: Path, number: int) -> Path | None:
    """Draws a figure from all of its data in a folder, and returns its path; None where there is no data.

    A row for each task and panel, success on the left and distance on the right; a line is the mean over the seeds, its
    band the 95 % interval.

    Raises:
      ValueError: a file of its data is not one.

    """
    paths = sorted(folder.glob(f"figure{number}-*.csv"), key=lambda path: ("longer" in path.name, path.name))
    rows = [row for path in paths for row in _read_curves(path)]
    if not rows:
        return None
    tasks = _in_order([*_TASKS, *(row["task"] for row in rows)])
    panels = [
        (task, panel) for task in tasks for panel in _in_order(row["panel"] for row in rows if row["task"] == task)
    ]
    figure, grid = plt.subplots(
        len(panels), 2, figsize=(9.5, 3.2 * len(panels)), constrained_layout=True, squeeze=False
    )
    colors = dict(zip(_in_order(row["setting"] for row in rows), itertools.cycle(_COLORS), strict=False))
    for axes, (task, panel) in zip(grid, panels, strict=True):
        of_panel = [row for row in rows if (row["task"], row["panel"]) == (task, panel)]
        for axis, (column, label, limits) in zip(axes, _PANELS, strict=True):
            _draw_lines(axis, of_panel, column, colors)
            axis.set(title=", ".join(filter(None, (task, panel))), xlabel="environment steps per seed", ylabel=label)
            axis.set_ylim(*limits)
            axis.grid(alpha=0.3)
            axis.spines[["top", "right"]].set_visible(False)
        axes[1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.suptitle(f"Figure {number}: {FIGURES[number]}{_commits(rows)}", fontsize=11)
    path = folder / f"figure{number}.png"
    with replace_file(path, "wb") as file:
        figure.savefig(file, dpi=130, format="png")
    plt.close(figure)
    return path


def _commits(rows: list[dict[str, str]]) -> str:
    """Says which commits made a figure's data, where they are several."""
    commits = sorted({row.get("commit") or "an older one" for row in rows})
    return f" (commits {', '.join(commits)})" if len(commits) > 1 else ""


def _draw_lines(axis: plt.Axes, rows: list[dict[str, Any]], column: str, colors: dict[str, tuple]) -> None:
    for setting in _in_order(row["setting"] for row in rows):
        of_setting = [row for row in rows if row["setting"] == setting]
        steps = sorted({float(row["env_steps"]) for row in of_setting})
        values = [[float(row[column]) for row in of_setting if float(row["env_steps"]) == step] for step in steps]
        mean = np.array([np.mean(over_seeds) for over_seeds in values])
        half = np.array([np.nan_to_num(confidence_interval(np.array(over_seeds))) for over_seeds in values])
        color = colors[setting]
        axis.plot(steps, mean, color=color, linewidth=1.8, marker="o", markersize=3, label=setting)
        axis.fill_between(steps, mean - half, mean + half, color=color, alpha=0.15, linewidth=0)


def _read_curves(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        for row in rows:
            for column in ("env_steps", "success", "distance"):
                float(row[column])
            if not {"task", "panel", "setting"} <= row.keys():
                raise KeyError("a column")
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise ValueError(f"{path} is not a figure's data: {error}") from error
    return rows


def _in_order(values: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(values))

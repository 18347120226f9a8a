"""The paper's figures, and one of the methods by TD3, drawn from the results of their studies."""

import itertools
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import EngFormatter, MaxNLocator

from experiments.figures import style_axes, write_figure
from experiments.paper.off_policy import OFF_POLICY_FIGURE
from experiments.paper.studies import STUDIES
from hgail_jax.trainer.statistics import confidence_interval

_COLORS = [plt.colormaps["tab20"](index) for index in (*range(0, 20, 2), *range(1, 20, 2))]  # the strong ones first
_TASKS = ("reach", "grasp")  # in the paper's order; others follow
_STEPS, _SECONDS = "environment steps per seed", "seconds of training, a setting's share"
_SUCCESS = ("success", "success rate", (-0.02, 1.02))
_PANELS = ((*_SUCCESS, _STEPS), ("distance_l1", "L1 distance at the end (m)", (0.0, None), _STEPS))
_PANELS_BY = {OFF_POLICY_FIGURE: ((*_SUCCESS, _STEPS), (*_SUCCESS, _SECONDS))}


def figure_path(folder: Path, number: int) -> Path:
    """Returns the path of a figure."""
    return folder / f"figure{number}.png"


def draw_figure(folder: Path, number: int) -> Path | None:
    """Draws a figure from the results of its studies in a folder, and returns its path; None if the folder has none.

    A row for each task and panel, success on the left, and on the right the distance, or success over a setting's share
    of the seconds of its program's training; a line is the mean over the seeds, its band the 95 % interval.

    Raises:
      ValueError: a file of the folder is not a study's.
    """
    studies = [study for study in STUDIES if study.figure == number]
    rows = [row for study in studies for row in _read_rows(folder, study.name)]
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
        for axis, (column, label, limits, over) in zip(axes, _PANELS_BY.get(number, _PANELS), strict=True):
            _draw_lines(axis, of_panel, column, over, colors)
            axis.set(title=", ".join(filter(None, (task, panel))), xlabel=over, ylabel=label)
            axis.set_ylim(*limits)
            axis.xaxis.set_major_locator(MaxNLocator(5))
            if over == _STEPS:
                axis.xaxis.set_major_formatter(EngFormatter(sep=""))  # 100k
            style_axes(axis)
        axes[1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.suptitle(f"Figure {number}: {studies[0].title}{_commits(rows)}", fontsize=11)
    path = figure_path(folder, number)
    write_figure(figure, path, dpi=130)
    return path


def _commits(rows: list[dict[str, Any]]) -> str:
    """Returns the commits that made a figure's data, if there are several."""
    commits = sorted({str(row["made_by"]["commit"]) for row in rows})
    return f" (commits {', '.join(commits)})" if len(commits) > 1 else ""


def _draw_lines(axis: plt.Axes, rows: list[dict[str, Any]], column: str, over: str, colors: dict[str, tuple]) -> None:
    for row in rows:
        along, values = np.array(row["curves"]["env_steps"]), np.array(row["curves"][column])
        if over == _SECONDS:
            along = along * row["seconds"] / along[-1]
        mean, half = values.mean(axis=1), np.nan_to_num(confidence_interval(values))
        color = colors[row["setting"]]
        axis.plot(along, mean, color=color, linewidth=1.8, marker="o", markersize=3, label=row["setting"])
        axis.fill_between(along, mean - half, mean + half, color=color, alpha=0.15, linewidth=0)


def _read_rows(folder: Path, study: str) -> list[dict[str, Any]]:
    """Returns the settings that a study has in a folder, each with the task."""
    rows = []
    for path in sorted(folder.glob(f"{study}-*.json")):
        try:
            content = json.loads(path.read_text())
            if content["study"] == study and "task" in content:
                rows += [row | {"task": content["task"]} for row in content["settings"]]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} is not what a study writes: {error}") from error
    return rows


def _in_order(values: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(values))

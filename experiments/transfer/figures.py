"""Draws the robustness curves of transferred policies."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from experiments.figures import style_axes, write_figure

_COLUMNS = 4  # of panels
_DASHES = ("-", (0, (6, 3)), (0, (3, 3)), (0, (1, 2)))  # of a line drawn over another, which shows in the gaps


def draw_sweep(path: Path, rows: Sequence[Mapping[str, Any]], axes: Mapping[str, str], policies: Sequence[str]) -> None:
    """Writes a PNG of a robot's success rates against each quantity, one task below the other, with 95 % intervals.

    Args:
      path: of the PNG.
      rows: the points of the robot, as measured; each quantity has a panel, each policy a colour.
      axes: the label of the x axis for each quantity.
      policies: the labels of policies in the order of their colours.
    """
    tasks: dict[str, dict[str, list[Mapping[str, Any]]]] = {}
    for row in rows:
        tasks.setdefault(row["task"], {}).setdefault(row["quantity"], []).append(row)
    heights = [math.ceil(len(panels) / _COLUMNS) for panels in tasks.values()]
    figure = plt.figure(figsize=(15, 3 * sum(heights)), layout="constrained")
    parts = figure.subfigures(len(tasks), squeeze=False, height_ratios=heights).flat
    drawn: dict[str, Any] = {}
    for part, height, (task, panels) in zip(parts, heights, tasks.items(), strict=True):
        part.suptitle(f"{rows[0]['robot']}: {task}")
        drawn |= _draw_panels(part.subplots(height, _COLUMNS, sharey=True, squeeze=False), panels, axes, policies)
    figure.legend(drawn.values(), drawn.keys(), loc="outside lower center", ncols=len(policies))
    write_figure(figure, path, dpi=90)


def _draw_panels(
    grid: np.ndarray,
    panels: Mapping[str, Sequence[Mapping[str, Any]]],
    axes: Mapping[str, str],
    policies: Sequence[str],
) -> dict[str, Any]:
    """Draws the panels of a task into axes, `[rows, columns]`; returns a line of each policy for the legend."""
    drawn = {}
    for panel, (name, points) in zip(grid.flat, panels.items(), strict=False):
        quantity, _, line = name.partition(", ")
        for index, policy in enumerate(policies):
            if of_policy := [point for point in points if point["policy"] == policy]:
                drawn[policy] = _draw_line(panel, of_policy, index)
        panel.set(xlabel=axes[quantity], title=line, ylim=(-0.03, 1.03))
        panel.xaxis.label.set_size(8)
        style_axes(panel)
    for panel in grid[:, 0]:
        panel.set_ylabel("success rate")
    for panel in grid.flat[len(panels) :]:
        panel.set_axis_off()
    return drawn


def _draw_line(panel: Axes, points: Sequence[Mapping[str, Any]], index: int) -> Any:
    rate, low, high = (
        np.array([point[column] for point in points]) for column in ("success_rate", "success_low", "success_high")
    )
    errors = np.maximum([rate - low, high - rate], 0.0)  # a rounded end may lie within the rate
    values = [point["value"] for point in points]
    style = index % len(_DASHES)
    return panel.errorbar(
        values,
        rate,
        errors,
        color=f"C{index}",
        linestyle=_DASHES[style],
        linewidth=2.4 - 0.3 * style,
        marker="os^D"[style],
        markersize=7.0 - 1.2 * style,
        elinewidth=1.2,
        capsize=2,
    )

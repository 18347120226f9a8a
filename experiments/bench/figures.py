"""Draws the success of learners over environment steps and over seconds."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

from experiments.figures import style_axes, write_figure

_PANELS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("env_steps", {"xscale": "log", "xlabel": "environment steps of a seed"}),
    ("train_seconds", {"xlim": (0.0, None), "xlabel": "seconds, with compilation"}),
)


def draw_learners(rows: list[dict[str, Any]], path: Path) -> None:
    """Draws rows of one task, see `learners.method_rows`: a line for each seed, a colour for each learner.

    Args:
      rows: at least one.
      path: of the PNG.

    """
    figure, axes = plt.subplots(1, 2, figsize=(10.0, 3.6), constrained_layout=True, sharey=True)
    learners = list(dict.fromkeys(row["what"] for row in rows))
    colors: dict[str, Any] = {name: plt.colormaps["tab10"](index % 10) for index, name in enumerate(learners)}
    for axis, (column, settings) in zip(axes, _PANELS, strict=True):
        named = set()
        for row in rows:
            style = {"color": colors[row["what"]], "linewidth": 1.5, "marker": "o", "markersize": 2.5, "alpha": 0.8}
            name = "_" if row["what"] in named else row["what"]  # once in the legend
            axis.plot(row[column], row["success"], label=name, **style)
            named.add(row["what"])
        axis.set(ylim=(-0.02, 1.02), **settings)
        style_axes(axis)
    axes[0].set_ylabel("success rate")
    axes[1].legend(fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    made_by = rows[-1]["made_by"]
    kind = made_by["device"]["kind"]
    where = f"{made_by['cpu_cores']} CPU cores" if made_by["device"]["platform"] == "cpu" else kind
    figure.suptitle(f"{rows[-1]['task']}, {where}", fontsize=11)
    write_figure(figure, path, dpi=130)

"""Tables and figures of the paper's experiments, from the results of their trials."""

import csv
import itertools
from collections.abc import Iterable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from scipy import stats

from experiments.paper.studies import FIGURES, LONGER, Study
from hgail_jax.io.files import replace_file
from hgail_jax.io.files import write_csv

_COLORS = [plt.colormaps["tab20"](index) for index in (*range(0, 20, 2), *range(1, 20, 2))]  # the strong ones first
_TASKS = ("reach", "grasp")  # in the paper's order; others follow
_PANELS = (
    ("success", "success rate", (-0.02, 1.02)),
    ("distance", "L1 distance at the end (m)", (0.0, None)),
)


def confidence_interval(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Returns half the width of the 95 % interval of the mean by Student's t; not a number where n is 1.

    >>> round(float(confidence_interval(np.array([1.0, 2.0, 3.0]))), 3)
    2.484
    """
    values = np.asarray(values, float)
    count = values.shape[axis]
    if count < 2:
        return np.full(values.mean(axis=axis).shape, np.nan)
    return stats.t.ppf(0.975, count - 1) * values.std(axis=axis, ddof=1) / np.sqrt(count)


def table_rows(task: str, study: Study, results: list[dict]) -> list[dict]:
    """Returns the rows of a table, one per setting, of what their trials ended with.

    `seconds` is a setting's share of the time that its program trained for.
    """
    rows = []
    for setting, result in zip(study.settings, results, strict=True):
        final, program = result["final"], result["program"]
        success, distance = np.array(final["success"]), np.array(final["distance_l1"])
        paper_success, paper_distance = setting.paper.get(task, ("", ""))
        rows.append(
            {
                "task": task,
                "method": setting.method,
                "setting": setting.name,
                "panel": setting.panel,
                "seeds": len(success),
                "success_rate": float(success.mean()),
                "success_ci95": _number(confidence_interval(success)),
                "worst_seed": float(success.min()),
                "achieved_rate": float(np.mean(final["achieved"])),
                "success_rate_l1": float(np.mean(final["success_l1"])),
                "distance_l1": float(distance.mean()),
                "distance_l1_ci95": _number(confidence_interval(distance)),
                "distance_l2": float(np.mean(final["distance_l2"])),
                "diverged_seeds": result["diverged_seeds"],
                "env_steps_per_seed": result["env_steps"][-1],
                "seconds": round(program["seconds"]["train"] / program["settings"], 3),
                "device": result["made_by"]["device"]["kind"],
                "paper_success": paper_success,
                "paper_distance_l1": paper_distance,
            }
        )
    return rows


def curve_rows(task: str, study: Study, results: list[dict]) -> list[dict]:
    """Returns the rows of a figure's data, one per setting, seed and round that was evaluated."""
    return [
        {
            "task": task,
            "method": setting.method,
            "setting": setting.name,
            "panel": setting.panel,
            "seed": seed,
            "round": number,
            "env_steps": steps,
            "success": success[seed],
            "distance": distance[seed],
        }
        for setting, result in zip(study.settings, results, strict=True)
        for number, steps, success, distance in zip(
            *(result[name] for name in ("rounds", "env_steps", "success", "distance_l1")), strict=True
        )
        for seed in range(len(success))
    ]


def write_markdown(path: Path, title: str, rows: list[dict]) -> None:
    """Writes a table, the paper's figures beside ours, with 95 % intervals over the seeds."""
    lines = [
        f"# {title}",
        "",
        "Mean and 95 % interval (Student's t) over the seeds, from the final evaluation of the mean action.",
        "",
        "| setting | seeds | success: paper | ours | L1 distance (m): paper | ours | env steps per seed | seconds |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        setting = ", ".join(filter(None, (row["setting"], row["panel"])))
        success = _with_interval(row["success_rate"], row["success_ci95"])
        distance = _with_interval(row["distance_l1"], row["distance_l1_ci95"])
        lines.append(
            f"| {setting} | {row['seeds']} | {row['paper_success']} | {success} | {row['paper_distance_l1']} |"
            f" {distance} | {row['env_steps_per_seed']:,} | {row['seconds']:.1f} |"
        )
    devices = ", ".join(sorted({row["device"] for row in rows}))
    lines += ["", f"Device: {devices}. Seconds: a setting's share of its program's training, compilation apart."]
    with replace_file(path) as file:
        file.write("\n".join(lines) + "\n")


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
    figure.suptitle(f"Figure {number}: {FIGURES[number]}", fontsize=11)
    path = folder / f"figure{number}.png"
    with replace_file(path, "wb") as file:
        figure.savefig(file, dpi=130, format="png")
    plt.close(figure)
    return path


def _draw_lines(axis, rows: list[dict], column: str, colors: dict[str, tuple]) -> None:
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


def write_study(folder: Path, task: str, study: Study, results: list[dict]) -> None:
    """Writes all of a study's `files`."""
    rows, paths = table_rows(task, study, results), files(folder, task, study)
    write_csv(paths["table"], rows)
    write_markdown(paths["markdown"], f"{study.title[0].upper()}{study.title[1:]}, {task}", rows)
    if study.figure is not None:
        write_csv(paths["curves"], curve_rows(task, study, results))
        draw_figure(folder, study.figure)


def files(folder: Path, task: str, study: Study) -> dict[str, Path]:
    """Returns the paths of a study's table, as CSV and Markdown, and of its figure and the figure's data."""
    paths = {"table": folder / f"{study.name}-{task}.csv", "markdown": folder / f"{study.name}-{task}.md"}
    if study.figure is not None:
        longer = "-longer" if study.name == LONGER else ""
        paths["curves"] = folder / f"figure{study.figure}{longer}-{task}.csv"
        paths["figure"] = folder / f"figure{study.figure}.png"
    return paths


def _in_order(values: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(values))


def _number(value: np.ndarray) -> float | None:
    return float(value) if np.isfinite(value) else None


def _with_interval(mean: float, half: float | None) -> str:
    return f"{mean:.3f}" if half is None else f"{mean:.3f} ± {half:.3f}"

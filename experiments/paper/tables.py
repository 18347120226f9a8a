"""The paper's tables, and all files of a study, from the results of its trials."""

from pathlib import Path
from typing import Any

import numpy as np

from experiments.paper.figures import draw_figure
from experiments.paper.studies import LONGER, Study
from hgail_jax.io.files import replace_file, write_csv
from hgail_jax.statistics import confidence_interval


def table_rows(task: str, study: Study, results: list[dict[str, Any]]) -> list[dict[str, Any]]:
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


def curve_rows(task: str, study: Study, results: list[dict[str, Any]]) -> list[dict[str, Any]]:
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


def write_markdown(path: Path, title: str, rows: list[dict[str, Any]]) -> None:
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


def write_study(folder: Path, task: str, study: Study, results: list[dict[str, Any]]) -> None:
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


def _number(value: np.ndarray) -> float | None:
    return float(value) if np.isfinite(value) else None


def _with_interval(mean: float, half: float | None) -> str:
    return f"{mean:.3f}" if half is None else f"{mean:.3f} ± {half:.3f}"

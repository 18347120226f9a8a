"""All files of a study: tables as CSV and Markdown, a figure and its data."""

from pathlib import Path
from typing import Any

import numpy as np

from experiments.paper.figures import draw_figure
from experiments.paper.rows import curve_rows, improvement_over_reference, improvement_rows, seed_rows, table_rows
from experiments.paper.seeds import describe_seeds
from experiments.paper.studies import LONGER
from experiments.paper.study import Study
from hgail_jax.io.files import replace_file, write_csv
from hgail_jax.trainer.statistics import Estimate

_OLDER = "**Older:** the settings of this table are no longer those of its name.\n\n"


def write_study(folder: Path, task: str, study: Study, results: list[dict[str, Any]]) -> None:
    """Writes all of a study's `files`."""
    paths = files(folder, task, study)
    write_csv(paths["table"], table_rows(task, study, results))
    write_csv(paths["seeds"], seed_rows(task, study, results))
    write_csv(paths["improvement"], improvement_rows(task, study, results))
    write_markdown(paths["markdown"], task, study, results)
    if study.figure is not None:
        write_csv(paths["curves"], curve_rows(task, study, results))
        draw_figure(folder, study.figure)


def files(folder: Path, task: str, study: Study) -> dict[str, Path]:
    """Returns the paths of a study's tables, as CSV and Markdown, and of its figure and the figure's data."""
    stem = f"{study.name}-{task}"
    paths = {
        "table": folder / f"{stem}.csv",
        "seeds": folder / f"{stem}-seeds.csv",
        "improvement": folder / f"{stem}-improvement.csv",
        "markdown": folder / f"{stem}.md",
    }
    if study.figure is not None:
        longer = "-longer" if study.name == LONGER else ""
        paths["curves"] = folder / f"figure{study.figure}{longer}-{task}.csv"
        paths["figure"] = folder / f"figure{study.figure}.png"
    return paths


def set_aside(folder: Path, paths: list[Path]) -> None:
    """Moves what is there of these files to a folder, and says in tables that they are older."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in paths:
        if path.suffix == ".md" and path.exists():
            content = path.read_text()
            with replace_file(path) as file:
                file.write(content if content.startswith(_OLDER) else _OLDER + content)
        if path.exists():
            path.replace(folder / path.name)


def write_markdown(path: Path, task: str, study: Study, results: list[dict[str, Any]]) -> None:
    """Writes a table, the paper's figures beside ours, with 95 % intervals over the seeds."""
    rows, improvements = table_rows(task, study, results), improvement_over_reference(study, results)
    lines = [
        f"# {study.title[0].upper()}{study.title[1:]}, {task}",
        "",
        f"{describe_seeds(results[0]['identity']['seeds'])} Final evaluation of the mean action; mean and 95 % interval"
        " (Student's t) over the seeds, and interquartile mean (IQM) and 95 % interval (stratified bootstrap). P is how"
        f" probably a seed has a higher success rate than one of {study.reference or study.settings[0].name}, ties"
        " counting half.",
        "",
        "| setting | seeds | success: paper | ours | IQM | P | L1 distance (m): paper | ours | IQM | env steps per seed"
        " | seconds |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for setting, row, improvement in zip(study.settings, rows, improvements, strict=True):
        older = f", *older* ({row['commit']})" if row["older"] else ""
        cells = [
            setting.label + older,
            row["seeds"],
            row["paper_success"],
            _plus_minus(row["success_rate"], row["success_ci95"]),
            _with_bounds(row, "success_iqm"),
            "" if improvement is None else _bounded(improvement, 2),
            row["paper_distance_l1"],
            _plus_minus(row["distance_l1"], row["distance_l1_ci95"]),
            _with_bounds(row, "distance_l1_iqm"),
            f"{row['env_steps_per_seed']:,}",
            f"{row['seconds']:.1f}",
        ]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    with replace_file(path) as file:
        file.write("\n".join([*lines, "", *_origin(rows)]) + "\n")


def _origin(rows: list[dict[str, Any]]) -> list[str]:
    """Returns lines that say what made a table."""
    lines = ["Seconds are a setting's share of its program's training, compilation apart. Made by"]
    made = dict.fromkeys((row["command"], row["commit"], row["device"], row["versions"]) for row in rows)
    return lines + [
        f"- `{command}`, commit {commit}, {device}; {versions}" for command, commit, device, versions in made
    ]


def _plus_minus(mean: float, half: float | None) -> str:
    return f"{mean:.3f}" if half is None else f"{mean:.3f} ± {half:.3f}"


def _with_bounds(row: dict[str, Any], name: str) -> str:
    bounds = (np.nan if row[f"{name}_{end}"] is None else row[f"{name}_{end}"] for end in ("low", "high"))
    return _bounded(Estimate(row[name], *bounds), 3)


def _bounded(estimate: Estimate, digits: int) -> str:
    value, low, high = (f"{number:.{digits}f}" for number in estimate)
    return value if np.isnan(estimate.low) else f"{value} ({low} to {high})"

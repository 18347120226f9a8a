"""Files of a study: its settings' results as JSON, and a table of them as Markdown."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from experiments.paper.figures import draw_figure
from experiments.paper.markdown import study_table, with_bounds
from experiments.paper.statistics import interquartile_mean, probability_of_improvement
from experiments.paper.study import Setting, Study
from hgail_jax.io.files import replace_file, write_json
from hgail_jax.trainer.statistics import Estimate, confidence_interval

_HEADER = {
    "label": "setting",
    "seeds": "seeds",
    "paper_success": "success: paper",
    "success": "ours",
    "success_iqm": "IQM",
    "better": "P",
    "paper_distance_l1": "L1 distance (m): paper",
    "distance_l1": "ours",
    "distance_l1_iqm": "IQM",
    "env_steps": "env steps per seed",
    "seconds": "seconds",
}
_OLDER = "**Older:** the settings of this table are no longer those of its name.\n\n"


def json_path(folder: Path, task: str, study: Study) -> Path:
    """Returns the path of a study's results; its table is beside it, as Markdown."""
    return folder / f"{study.name}-{task}.json"


def read_study(path: Path) -> dict[str, Any]:
    """Returns the content of a JSON file of the folder.

    Raises:
      ValueError: the file is damaged.
    """
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is damaged, remove it: {error}") from None


def write_study(folder: Path, task: str, study: Study, results: list[dict[str, Any]]) -> None:
    """Writes the results of a study's trials, their table, and the study's figure."""
    rows = make_rows(task, study, results)
    path = json_path(folder, task, study)
    write_json(path, {"study": study.name, "task": task, "settings": rows})
    write_markdown(path.with_suffix(".md"), task, study, rows)
    if study.figure is not None:
        draw_figure(folder, study.figure)


def set_aside(folder: Path, path: Path) -> None:
    """Moves a study's results and table to a folder, and marks the table as older."""
    folder.mkdir(parents=True, exist_ok=True)
    table = path.with_suffix(".md")
    if table.exists():
        with replace_file(folder / table.name) as file:
            file.write(_OLDER + table.read_text())
        table.unlink()
    path.replace(folder / path.name)


def make_rows(task: str, study: Study, results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the rows of a study, one per setting, from the results of its trials.

    `seconds` is the program's training time divided by its number of settings. A row is `older` if another one of the
    study was made later by another commit. `better_than` has the probability that a seed of the setting has a higher
    success rate than one of each later setting, and the bounds of its 95 % interval.
    """
    newest = max((result["made_by"] for result in results), key=lambda made_by: made_by["date"])["commit"]
    rows = []
    for index, (setting, result) in enumerate(zip(study.settings, results, strict=True)):
        program = result["program"]
        paper_success, paper_distance = setting.paper.get(task, ("", ""))
        rows.append(
            {
                "setting": setting.name,
                "panel": setting.panel,
                **_statistics(result["final"]),
                "diverged_seeds": result["diverged_seeds"],
                "env_steps_per_seed": result["curves"]["env_steps"][-1],
                "seconds": round(program["seconds"]["train"] / program["settings"], 3),
                "paper_success": paper_success,
                "paper_distance_l1": paper_distance,
                "older": result["made_by"]["commit"] != newest,
                "better_than": {
                    other.label: [_number(end) for end in _improvement(result, of_other)]
                    for other, of_other in list(zip(study.settings, results, strict=True))[index + 1 :]
                },
                **{name: result[name] for name in ("identity", "final", "program", "made_by")},
                **({"curves": result["curves"]} if study.curves or study.figure is not None else {}),
            }
        )
    return rows


def _statistics(final: dict[str, list[float]]) -> dict[str, float | None]:
    """Returns statistics of the final evaluation over the seeds."""
    success, distance = np.array(final["success"]), np.array(final["distance_l1"])
    return {
        "success_rate": float(success.mean()),
        "success_ci95": _number(confidence_interval(success)),
        **_estimate("success_iqm", interquartile_mean(success)),
        "worst_seed": float(success.min()),
        "achieved_rate": float(np.mean(final["achieved"])),
        "success_rate_l1": float(np.mean(final["success_l1"])),
        "distance_l1": float(distance.mean()),
        "distance_l1_ci95": _number(confidence_interval(distance)),
        **_estimate("distance_l1_iqm", interquartile_mean(distance)),
        "distance_l2": float(np.mean(final["distance_l2"])),
    }


def write_markdown(path: Path, task: str, study: Study, rows: list[dict[str, Any]]) -> None:
    """Writes a table, the paper's figures beside ours, with 95 % intervals over the seeds."""
    by_label = {setting.label: row for setting, row in zip(study.settings, rows, strict=True)}
    seeds = rows[0]["identity"]["seeds"]
    lines = [
        f"# {study.title[0].upper()}{study.title[1:]}, {task}",
        "",
        f"Seeds {seeds[0]} to {seeds[-1]}; settings are chosen on others. Final evaluation of the mean action; mean and"
        " 95 % interval (Student's t) over the seeds, and interquartile mean (IQM) and 95 % interval (bootstrap). P is"
        f" how probably a seed has a higher success rate than one of {study.reference or study.settings[0].name}, ties"
        " counting half.",
        "",
        study_table([_with_comparison(study, setting, by_label) for setting in study.settings], _HEADER),
        "",
        *_origin(rows),
    ]
    with replace_file(path) as file:
        file.write("\n".join(lines) + "\n")


def _with_comparison(study: Study, setting: Setting, by_label: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Returns a setting's row with its label, and the comparison with the study's reference."""
    row, reference = by_label[setting.label], study.compared_with(setting)
    older = f", *older* ({row['made_by']['commit']})" if row["older"] else ""
    if reference is None:
        return row | {"label": setting.label + older, "better": ""}
    better = _estimate("P", _improvement(row, by_label[reference.label]))
    return row | {"label": setting.label + older, "better": with_bounds(better, "P", 2)}


def _origin(rows: list[dict[str, Any]]) -> list[str]:
    """Returns the lines about a table's provenance."""
    lines = ["Seconds are a setting's share of its program's training, compilation apart. Made by"]
    for row in rows:
        by = row["made_by"]
        lines.append(f"- `{by['command']}`, commit {by['commit']}, {by['device']['kind']}; {_versions(by['versions'])}")
    return list(dict.fromkeys(lines))


def _versions(versions: dict[str, str | None]) -> str:
    return "; ".join(f"{name} {version}" for name, version in versions.items() if version is not None)


def _improvement(row: dict[str, Any], other: dict[str, Any]) -> Estimate:
    return probability_of_improvement(*(np.array(one["final"]["success"]) for one in (row, other)))


def _estimate(name: str, estimate: Estimate) -> dict[str, float | None]:
    return {name: estimate.value, f"{name}_low": _number(estimate.low), f"{name}_high": _number(estimate.high)}


def _number(value: np.ndarray | float) -> float | None:
    return float(value) if np.isfinite(value) else None

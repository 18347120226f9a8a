"""Adds runs and studies to the published results: `python -m experiments.publish runs/push-td3-1`.

A run's folder becomes a row of `results/runs.json`, the settings of a study's file, `<study>-<task>.json`, rows of
`results/studies.json`; they replace older ones of the same name. A `table4.json` becomes the one of `results`. Curves
stay where they are.
"""

import csv
import itertools
import json
import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from experiments import RESULTS
from experiments.paper.trials import hash_json
from hgail_jax.io.files import replace_file
from hgail_jax.trainer.statistics import confidence_interval

Row = dict[str, Any]

RUNS = RESULTS / "runs.json"
STUDIES = RESULTS / "studies.json"
TABLE4 = RESULTS / "table4.json"
_MADE_BY = ("command", "commit", "device", "cpu_cores", "versions")
_PICTURES = {"look": "look", "kind": "picture_kind"}  # options that tell policies of pictures apart
_LEAST = ("0.80", "0.95")  # success rates of which the first time is kept


def run_row(folder: Path) -> Row:
    """Returns the row of a run from its folder.

    Raises:
      OSError: a file of a finished run is missing.
    """
    config, summary = (json.loads((folder / name).read_text()) for name in ("config.json", "summary.json"))
    success, nominal = summary["success_rate"], summary.get("nominal_success_rate")
    half = float(confidence_interval(success["per_seed"]))
    first = config.get("first_seed", 0)
    with (folder / "metrics.csv").open(newline="") as file:
        tests = list(_tests(csv.DictReader(file)))
    return {
        "name": folder.name,
        "task": summary["task"],
        "method": summary["method"],
        "learner": config["config"]["learner"]["name"],
        "level": config["options"].get("randomize") or "none",
        "environment_reward": config["hyperparameters"]["environment_reward"],
        **({new: config["options"][name] for new, name in _PICTURES.items()} if summary["method"] == "camera" else {}),
        "seeds": list(range(first, first + summary["seeds"])),
        "episodes_per_seed": summary["evaluation_episodes_per_seed"],
        "success": success,
        "success_ci95": half if math.isfinite(half) else None,
        "worst": min(success["per_seed"]),
        "nominal_success": nominal,
        "distance_l1": summary["distance_l1"]["mean"],
        "env_steps": summary["env_steps_per_seed"],
        "reached": {least: _first(tests, float(least)) for least in _LEAST},
        "seconds": summary["wall_seconds"],
        "env_steps_per_second": summary["env_steps_per_second"],
        **{name: summary[name] for name in _MADE_BY if name in summary},
    }


def _tests(rows: Iterable[dict[str, str]]) -> Iterator[tuple[int, float, float]]:
    """Yields of each test of a training the steps of a seed, the seconds, and the mean success of the seeds."""
    measured = [row for row in rows if row["success_rate"]]
    for steps, seeds in itertools.groupby(measured, lambda row: round(float(row["env_steps"]))):
        each = list(seeds)
        yield steps, float(each[0]["seconds"]), mean(float(row["success_rate"]) for row in each)


def _first(tests: Iterable[tuple[int, float | None, float]], least: float) -> Row | None:
    """Returns the steps and seconds of the first test in which the mean of the seeds was at least this high."""
    return next(({"env_steps": steps, "seconds": time} for steps, time, rate in tests if rate >= least), None)


def study_rows(path: Path) -> list[Row]:
    """Returns the rows of a study's file, without curves."""
    content = json.loads(path.read_text())
    return [{name: content[name] for name in ("study", "task")} | _setting(row) for row in content["settings"]]


def _setting(row: Row) -> Row:
    identity, made_by, curves = row["identity"], row["made_by"], row.get("curves", {"env_steps": [], "success": []})
    tests = zip(curves["env_steps"], [None] * len(curves["env_steps"]), map(mean, curves["success"]), strict=True)
    return {
        **{name: row[name] for name in ("setting", "panel")},
        "method": identity["method"],
        "seeds": identity["seeds"],
        "success": row["final"]["success"],
        **{name: row[name] for name in ("success_ci95", "worst_seed", "distance_l1", "env_steps_per_seed")},
        "steps_to_95": (_first(tests, 0.95) or {}).get("env_steps"),
        **{name: row[name] for name in ("paper_success", "paper_distance_l1")},
        "identity": hash_json(identity),
        "made_by": {name: made_by[name] for name in _MADE_BY if name in made_by},
    }


def add_runs(path: Path, rows: Sequence[Row]) -> None:
    """Adds runs to a file, an entry a line; they replace runs of the same names."""
    kept = {row["name"]: row for row in (*_read(path, []), *rows)}
    entries = [",\n".join(f"  {json.dumps(name)}: {json.dumps(row[name])}" for name in row) for row in kept.values()]
    _write(path, "[\n" + ",\n".join(f" {{\n{row}\n }}" for row in entries) + "\n]\n")


def add_studies(path: Path, rows: Sequence[Row]) -> None:
    """Adds rows of studies to a file, a row a line; they replace all rows of the same study and task.

    What made a row is in `made_by`, by a hash that the row has.
    """
    content = _read(path, {"made_by": {}, "rows": []})
    made_by, new = content["made_by"], {(row["study"], row["task"]) for row in rows}
    kept = [row for row in content["rows"] if (row["study"], row["task"]) not in new]
    for row in rows:
        made_by[key := hash_json(row["made_by"])] = row["made_by"]
        kept.append(row | {"made_by": key})
    used = {row["made_by"] for row in kept}
    write_table(path, {key: made for key, made in made_by.items() if key in used}, kept)


def write_table(path: Path, made_by: Row, rows: Sequence[Row]) -> None:
    """Writes a JSON file of `rows` and what made them, an entry of either a line."""
    sources = ",\n".join(f"{json.dumps(key)}: {json.dumps(made)}" for key, made in made_by.items())
    table = ",\n".join(json.dumps(row) for row in rows)
    _write(path, f'{{"made_by": {{\n{sources}\n}}, "rows": [\n{table}\n]}}\n')


def _read(path: Path, empty: Any) -> Any:
    return json.loads(path.read_text()) if path.exists() else empty


def _write(path: Path, text: str) -> None:
    with replace_file(path) as file:
        file.write(text)


def main(paths: Sequence[str]) -> None:
    """Publishes runs' folders, studies' files and table 4; ends with a line about a file or folder that is none."""
    for path in map(Path, paths):
        try:
            if path.is_dir():
                add_runs(RUNS, [run_row(path)])
            elif path.name == TABLE4.name:
                write_table(TABLE4, **json.loads(path.read_text()))
            else:
                add_studies(STUDIES, study_rows(path))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SystemExit(
                f"publish: {path} is not a finished run's folder, a study's file or table 4: {error!r}"
            ) from error


if __name__ == "__main__":
    main(sys.argv[1:])

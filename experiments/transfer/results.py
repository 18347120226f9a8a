"""Writes the files of a folder: table 4 and the sweep's curves."""

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.transfer.figures import draw_sweep
from experiments.transfer.measurement import measure_rows
from experiments.transfer.policies import Policies, table_policies
from experiments.transfer.robots import ROBOTS
from experiments.transfer.studies import (
    FETCH,
    axes,
    fetch_points,
    fetch_rows,
    measured_pairs,
    robot_name,
    robot_points,
    table,
)
from hgail_jax.io.files import write_json
from hgail_jax.io.provenance import installed, provenance
from hgail_jax.terminal import progress_bar


def write_table(
    folder: Path,
    sources: Sequence[str],
    robots: Sequence[str],
    tasks: Sequence[str],
    episodes: int,
    seed: int,
    workers: int,
) -> Path:
    """Writes table4.json, the rows and their provenance, and returns its path.

    Rows of other goal sources, robots or tasks stay in the file, with their provenance.

    Args:
      folder: of the files.
      sources: names in `GOAL_SOURCES`.
      robots: names in `ROBOTS`.
      tasks: of the rows.
      episodes: for each row.
      seed: of the episodes.
      workers: processes that measure side by side.
    """
    path = folder / "table4.json"
    points = list(table(sources, robots, tasks, table_policies()))
    measured = [_part(point.labels["stage"], ROBOTS[point.to].name, point.task) for point in points]
    rows, made_by = _kept(path, lambda row: _part(row["stage"], row["robot"], row["task"]) not in measured)
    made_by |= dict.fromkeys(measured, _made_by(episodes, seed))
    for row in measure_rows(points, episodes, seed, workers):
        rows.append(row)
        write_json(path, {"made_by": made_by, "rows": rows})
    return path


def write_sweep(
    folder: Path,
    policies: Policies,
    robots: Sequence[str],
    tasks: Sequence[str],
    episodes: int,
    seed: int,
    workers: int,
) -> list[Path]:
    """Writes transfer-sweep.json, the points of the curves and their provenance, and its figures; returns their paths.

    Curves of other robots or tasks stay in the file, with their provenance.

    Args:
      folder: of the files.
      policies: by label and task.
      robots: names in `ROBOTS`, or `sweeps.FETCH`.
      tasks: of the curves.
      episodes: for each point.
      seed: of the episodes.
      workers: processes that measure other robots side by side.
    """
    path = folder / "transfer-sweep.json"
    curves = [_part(robot_name(to), task) for to, task in measured_pairs(policies, robots, tasks)]
    rows, made_by = _kept(path, lambda row: _part(row["robot"], row["task"]) not in curves)
    points = list(robot_points(policies, [to for to in robots if to != FETCH], tasks))
    count = len(fetch_points(policies, tasks)) if FETCH in robots else 0
    on_fetch = progress_bar(fetch_rows(policies, tasks, episodes, seed), total=count, unit="point") if count else ()
    elsewhere = measure_rows(points, episodes, seed, workers) if points else ()
    made_by |= dict.fromkeys(curves, _made_by(episodes, seed))
    for row in itertools.chain(on_fetch, elsewhere):
        rows.append(row)
        write_json(path, {"made_by": made_by, "rows": rows})
    return [path, *draw_sweeps(folder, rows)]


def draw_sweeps(folder: Path, rows: Sequence[Mapping[str, Any]]) -> list[Path]:
    """Writes transfer-sweep-<robot>.png for each robot of a sweep's points, and returns their paths."""
    names = {robot_name(to): to for to in (FETCH, *ROBOTS)}
    policies = list(dict.fromkeys(row["policy"] for row in rows))
    curves: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        curves.setdefault(names[row["robot"]], []).append(row)
    paths = {to: folder / f"transfer-sweep-{to}.png" for to in curves}
    for to, points in curves.items():
        draw_sweep(paths[to], points, axes(), policies)
    return list(paths.values())


def _part(*columns: str) -> str:
    """Returns the key in a file's `made_by` of the rows with these values."""
    return ": ".join(columns)


def _kept(path: Path, stays: Callable[[Mapping[str, Any]], bool]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Returns the rows of a file that stay, and its provenance; nothing if there is no file yet."""
    if not path.exists():
        return [], {}
    content = json.loads(path.read_text())
    kept = [row for row in content["rows"] if stays(row)]
    return kept, content["made_by"] if kept else {}


def _made_by(episodes: int, seed: int) -> dict[str, Any]:
    made_by = provenance()
    made_by["versions"] |= installed(*(package for robot in ROBOTS.values() for package in robot.packages))
    return {"seed": seed, "episodes": episodes} | made_by

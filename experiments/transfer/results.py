"""Measures table 4 and the robustness curves, draws the pictures, and writes their files into a folder."""

import contextlib
import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from experiments.transfer.figures import draw_strip, draw_sweep
from experiments.transfer.measurement import Measured, Point, load_policies
from experiments.transfer.robots import ROBOTS, make_robot
from experiments.transfer.studies import stage, table
from experiments.transfer.sweeps import FETCH, Policies, axes, fetch_rows, measure_points, robot_points
from experiments.transfer.tasks import TASKS
from hgail_jax.io.files import write_csv, write_json
from hgail_jax.io.versions import installed
from hgail_jax.trainer.provenance import provenance


def write_table(folder: Path, sources: Sequence[str], episodes: int, seed: int) -> None:
    """Writes table4.csv, and table4.json that says what made it.

    Rows that are there already stay, with what is said of them, where their goal is of another source.

    Args:
      folder: where to.
      sources: the `GOAL_SOURCES` whose rows are measured.
      episodes: for each row.
      seed: of the episodes.

    Raises:
      RuntimeError: MuJoCo cannot render here, and the goal is to be seen.

    """
    path, kept, made_by = folder / "table4.csv", [], {}
    stages = [stage(source) for source in sources]
    if path.exists():
        with path.open(newline="") as file:
            kept = [row for row in csv.DictReader(file) if row["stage"] not in stages]
    if kept:
        made_by = json.loads(path.with_suffix(".json").read_text())
    with contextlib.ExitStack() as stack:
        _write_rows(path, list(table(sources, stack)), episodes, seed, kept)
    write_json(path.with_suffix(".json"), made_by | dict.fromkeys(stages, _made_by(episodes, seed)))


def write_sweep(
    folder: Path,
    policies: Policies,
    robots: Sequence[str],
    tasks: Sequence[str],
    episodes: int,
    seed: int,
    workers: int,
) -> None:
    """Writes transfer-sweep.csv, its .png, and the .json that says what made it.

    Args:
      folder: where to.
      policies: what decides, by label and task.
      robots: names in `ROBOTS`, or `sweeps.FETCH`.
      tasks: of the curves.
      episodes: for each point.
      seed: of the episodes.
      workers: processes that measure other robots side by side.

    """
    path = folder / "transfer-sweep.csv"
    rows: list[dict[str, Any]] = []
    with tqdm(unit="point") as progress:

        def add(row: dict[str, Any]) -> None:
            rows.append(row)
            write_csv(path, rows)
            progress.update()

        if FETCH in robots:
            for row in fetch_rows(policies, tasks, episodes, seed):
                add(row)
        points = list(robot_points(policies, [to for to in robots if to != FETCH], tasks))
        distinct = list({point.key(): point for point in points}.values())  # each curve has the undisturbed point
        measured = iter(measure_points(distinct, episodes, seed, workers))
        done: dict[tuple, Measured] = {}
        for point in points:
            if point.key() not in done:
                done[point.key()] = next(measured)
            add(point.row(done[point.key()]))
    write_json(path.with_suffix(".json"), _made_by(episodes, seed))
    draw_sweep(path.with_suffix(".png"), rows, axes())


def write_pictures(folder: Path, seed: int) -> None:
    """Writes transfer-<robot>.png for each robot: one episode of each task, by its first policy.

    Raises:
      RuntimeError: MuJoCo cannot render here.

    """
    for to in ROBOTS:
        episodes = [(make_robot(to, name), load_policies(name)[0], task.pictured_steps) for name, task in TASKS.items()]
        draw_strip(folder / f"transfer-{to}.png", episodes, seed)


def _write_rows(
    path: Path, points: Sequence[Point], episodes: int, seed: int, kept: Sequence[dict] = ()
) -> list[dict[str, Any]]:
    """Measures points; after each, writes the rows kept and those measured so far, and returns them in the end."""
    rows = list(kept)
    measured: dict[tuple, Measured] = {}
    with tqdm(total=len(points) * episodes, unit="episode") as progress:
        for point in points:
            progress.set_description(" ".join(map(str, (point.to, point.task, *point.labels.values()))))
            key = point.key()
            if key in measured:  # the undisturbed point is part of every curve
                progress.update(episodes)
            else:
                measured[key] = point.measure(episodes, seed, progress.update)
            rows.append(point.row(measured[key]))
            write_csv(path, rows)
    return rows


def _made_by(episodes: int, seed: int) -> dict[str, Any]:
    made_by = provenance()
    made_by["versions"] |= installed(*(package for robot in ROBOTS.values() for package in robot.packages))
    return {"seed": seed, "episodes": episodes} | made_by

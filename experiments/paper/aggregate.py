"""What a setting comes to over several tasks."""

import csv
from pathlib import Path

import numpy as np

from experiments.paper.tables import files
from experiments.paper.work import Work
from hgail_jax.io.files import write_csv
from hgail_jax.trainer.statistics import interquartile_mean


def write_aggregates(works: list[Work]) -> None:
    """Writes <study>-<task>-<task>.csv for each study that all of several tasks have in the folder.

    A row is the interquartile mean of a setting's success rate over the seeds of all tasks; the bootstrap draws within
    each task.
    """
    if len(works) < 2:
        return
    in_all = [study for study in works[0].studies if all(study in work.studies for work in works)]
    for study in in_all:
        paths = [files(work.folder, work.task, study)["seeds"] for work in works]
        found = [_success(path) for path in paths if path.exists()]
        if len(found) < len(works):
            continue
        rows = []
        for setting in study.settings:
            value, low, high = interquartile_mean(*(success[setting.name, setting.panel] for success in found))
            estimate = {"success_iqm": value, "success_iqm_low": low, "success_iqm_high": high}
            rows.append({"setting": setting.name, "panel": setting.panel, **estimate})
        write_csv(works[0].folder / f"{'-'.join([study.name, *(work.task for work in works)])}.csv", rows)


def _success(path: Path) -> dict[tuple[str, str], np.ndarray]:
    """Returns the success rates of the seeds of each setting and panel."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    found: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        found.setdefault((row["setting"], row["panel"]), []).append(float(row["success_rate"]))
    return {name: np.array(values) for name, values in found.items()}

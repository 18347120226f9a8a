"""Row of a workload: its speed of stepping, roll-outs and training, and their ratios."""

from collections.abc import Collection
from typing import Any

from experiments.bench.floors import measure_floors
from experiments.bench.stepping import Stepping
from experiments.bench.timing import seconds_side_by_side
from experiments.bench.training import Learning, RollingOut, round_fractions
from experiments.bench.workload import Workload

COLUMNS = ("physics", "rollout", "train", "shares")
"""Groups of columns to measure; `shares`, the fractions of a round's time, need and include the others."""


def speed_row(workload: Workload, columns: Collection[str]) -> dict[str, Any]:
    """Measures the named groups of `COLUMNS`."""
    wanted = set(COLUMNS if "shares" in columns else columns)
    row: dict[str, Any] = {
        "task": workload.task,
        "impl": workload.env.impl,
        "num_envs": workload.num_envs,
        "substeps": workload.substeps,
        "what": ", ".join(name for name in COLUMNS if name in wanted),
    }
    parts: list[Stepping | RollingOut | Learning] = []
    if "physics" in wanted:
        parts.append(Stepping(workload))
        row |= measure_floors(workload)
    if "rollout" in wanted:
        parts.append(RollingOut(workload))
    if "train" in wanted:
        parts.append(Learning(workload, each_phase="shares" in wanted))
    seconds = seconds_side_by_side({name: call for part in parts for name, call in part.calls.items()})
    for part in parts:
        row |= part.row(seconds)
    if {"physics", "train"} <= wanted:
        row["train_to_raw"] = row["train_env_steps_per_second"] / row["raw_env_steps_per_second"]
    return row | (round_fractions(workload, row) if "shares" in wanted else {})

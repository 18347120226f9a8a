"""Rows of a workload: its speed of stepping, roll-outs and training, and their ratios."""

import dataclasses
import functools
from collections.abc import Callable, Collection, Mapping
from typing import Any, Protocol

from experiments.bench.floors import measure_floors
from experiments.bench.stepping import Stepping
from experiments.bench.timing import seconds_side_by_side
from experiments.bench.training import Learning, PPOPhases, RollingOut, Training, round_fractions
from experiments.bench.updates import UpdateParts, update_fractions
from experiments.bench.workload import Workload
from hgail_jax.learners import TD3

COLUMNS = ("physics", "rollout", "train", "shares")
"""Groups of columns to measure; `shares`, the fractions of a round's time, need and include the others."""


class _Part(Protocol):
    """Calls to be timed, and the columns that their times give."""

    calls: dict[str, Callable[[], Any]]

    def row(self, seconds: Mapping[str, float]) -> dict[str, float]: ...


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
    off_policy = isinstance(workload.preset.config.learner, TD3)
    parts: list[_Part] = []
    if "physics" in wanted:
        parts.append(Stepping(workload))
        row |= measure_floors(workload)
    if "rollout" in wanted:
        parts.append(RollingOut(workload))
    if "train" in wanted:
        training = Training(workload)
        parts.append(Learning(training))
        if "shares" in wanted:
            parts.append(UpdateParts(training) if off_policy else PPOPhases(training))
    row |= _measured(parts)
    if {"physics", "train"} <= wanted:
        row["train_to_raw"] = row["train_env_steps_per_second"] / row["raw_env_steps_per_second"]
    if "shares" not in wanted:
        return row
    stepping = workload.env_steps / row["raw_env_steps_per_second"]
    return row | (update_fractions(row, stepping) if off_policy else round_fractions(workload, row))


def update_row(workload: Workload, seeds: int) -> dict[str, Any]:
    """Measures an update phase of the learner TD3 by parts, of seeds with `workload.num_envs` environments each.

    Stepping and the engine's bare loops are of all their environments in one batch.
    """
    together = seeds * workload.num_envs
    row: dict[str, Any] = {
        "task": workload.task,
        "impl": workload.env.impl,
        "substeps": workload.substeps,
        "seeds": seeds,
        "num_envs_per_seed": workload.num_envs,
        **_stepping_row(dataclasses.replace(workload, num_envs=together)),
    }
    training = Training(dataclasses.replace(workload, worlds=together), seeds)
    row |= {"train_compile_seconds": training.compile_seconds} | _measured([UpdateParts(training)])
    return row | update_fractions(row, seeds * workload.env_steps / row["raw_env_steps_per_second"])


@functools.cache
def _stepping_row(workload: Workload) -> dict[str, float]:
    """Measures stepping alone; several numbers of seeds and environments have the same worlds."""
    return _measured([Stepping(workload)])


def _measured(parts: Collection[_Part]) -> dict[str, float]:
    """Returns the columns of all parts, whose calls are timed in turn."""
    seconds = seconds_side_by_side({name: call for part in parts for name, call in part.calls.items()})
    return {name: value for part in parts for name, value in part.row(seconds).items()}

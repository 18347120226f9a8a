"""Compares the Fetch tasks with Gymnasium-Robotics' on the same machine, and writes a table.

python -m experiments.parity
"""

import dataclasses
from pathlib import Path

import numpy as np

import hgail_envs
from experiments.parity.reference import (
    make_counterpart,
    one_step_errors,
    open_loop_drift,
    open_loop_ends,
    random_moves,
)
from hgail_envs.tasks.arm import FAST_SUBSTEPS, REFERENCE_SUBSTEPS
from hgail_jax.cli.command_line import fail, one_line_errors, parse, prepare_process
from hgail_jax.io.files import check_writable, write_json
from hgail_jax.io.provenance import provenance

PROGRAM = "parity"

_ROWS = (
    ("reach", "c", REFERENCE_SUBSTEPS),
    ("reach", "c", FAST_SUBSTEPS),
    ("reach", "jax", REFERENCE_SUBSTEPS),
    ("reach", "jax", FAST_SUBSTEPS),
    ("grasp", "c", REFERENCE_SUBSTEPS),
    ("grasp", "c", 8),
    ("push", "c", REFERENCE_SUBSTEPS),
    ("pick-and-place", "c", REFERENCE_SUBSTEPS),
    ("slide", "c", REFERENCE_SUBSTEPS),
)


@dataclasses.dataclass(frozen=True)
class Command:
    """Measures the distance of the gripper from the reference's, for each engine that runs on a CPU."""

    out: Path = Path("runs/parity/parity.json")
    """File to write."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line."""
    command = parse(Command, PROGRAM, __doc__, arguments)
    try:
        check_writable(command.out)
    except OSError as error:
        fail(PROGRAM, error, 2)
    rows = []
    for task, impl, substeps in _ROWS:
        rows.append(measure(task, impl, substeps))
        print(
            "  ".join(
                f"{name} {value:.3g}" if isinstance(value, float) else f"{value}" for name, value in rows[-1].items()
            )
        )
    command.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(command.out, {"rows": rows, "made_by": provenance()})


def measure(task: str, impl: str, substeps: int) -> dict[str, str | int | float]:
    """Returns a row of the table: errors of the gripper in one action and drifts without feedback, millimetres."""
    env = hgail_envs.make(task, impl=impl, substeps=substeps)
    reference = make_counterpart(env)
    errors = 1000 * one_step_errors(env, reference, random_moves(reference))
    drift = 1000 * open_loop_drift(env, *open_loop_ends(reference))
    return {
        "task": task,
        "reference": str(env.reference),
        "impl": impl,
        "substeps": substeps,
        "moves": len(errors),
        "one_step_median_mm": float(np.median(errors)),
        "one_step_p99_mm": float(np.percentile(errors, 99)),
        "episodes": len(drift),
        "drift_median_mm": float(np.median(drift)),
        "drift_worst_mm": float(drift.max()),
    }


if __name__ == "__main__":
    with one_line_errors(PROGRAM):
        prepare_process()
        main()

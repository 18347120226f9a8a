"""The teacher of a student: the options of its own training, and the best of its seeds."""

import json
from pathlib import Path

from hgail_jax.trainer.options import TrainOptions

TEACHER = "teacher.npz"
"""Name of the teacher's file in a student's folder."""
_SHARED = (
    *("task", "seeds", "first_seed", "robot", "impl", "substeps", "task_options", "devices", "checkpoint_every"),
    *("evaluation_episodes", "logger"),
)
"""Options of a student's training that its teacher's has too."""


def teacher_options(options: TrainOptions) -> TrainOptions:
    """Returns the options of the training of a teacher, by the task's default method, for a student's training."""
    out = None if options.out is None else options.out.with_name(f"{options.out.name}-teacher")
    return TrainOptions(out=out, **{name: getattr(options, name) for name in _SHARED})


def kept_teacher(folder: Path) -> Path | None:
    """Returns the teacher's file in the folder of a student's run; None if there is none."""
    path = folder / TEACHER
    return path if path.exists() else None


def best_policy(folder: Path) -> Path:
    """Returns the policy of the seed of a finished run that had the most success, of equal ones the first."""
    summary = json.loads((folder / "summary.json").read_text())
    first = json.loads((folder / "config.json").read_text())["first_seed"]
    success = summary["success_rate"]["per_seed"]
    return folder / "policies" / f"seed-{first + success.index(max(success))}.npz"

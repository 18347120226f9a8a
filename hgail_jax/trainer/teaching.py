"""The teacher of a student: the options of the teacher's training, and the best of its seeds."""

import json
from pathlib import Path
from typing import Any

from hgail_jax.trainer.train_options import TrainOptions

_SHARED = (
    *("task", "seeds", "first_seed", "robot", "impl", "substeps", "task_options", "devices", "checkpoint_every"),
    *("evaluation_episodes", "logger"),
)
"""Options of a student's training that its teacher's has too."""


def teacher_options(options: TrainOptions, folder: Path) -> TrainOptions:
    """Returns the options of the training of a teacher, by the task's default method, for a student's training.

    The `folder` is the student's. The teacher's is beside it, and resumed where it is there already.
    """
    out = folder.with_name(f"{folder.name}-teacher")
    place: dict[str, Any] = {"resume": str(out)} if out.exists() else {"out": out}
    return TrainOptions(**place, **{name: getattr(options, name) for name in _SHARED})


def best_policy(folder: Path) -> Path:
    """Returns the policy of the seed of a finished run that had the most success, of equal ones the first."""
    summary = json.loads((folder / "summary.json").read_text())
    first = json.loads((folder / "config.json").read_text())["first_seed"]
    success = summary["success_rate"]["per_seed"]
    return folder / "policies" / f"seed-{first + success.index(max(success))}.npz"

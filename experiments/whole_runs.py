"""Measures whole runs of run.py, each in a process of its own: compilation, and the time to a success rate."""

import csv
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

_RUN = Path(__file__).parent / "run.py"
SUCCESS = {"reach": 0.98, "grasp": 0.95}
"""The success rate that every seed is to reach, by task."""


def _run(folder: Path, cache: Path, arguments: list[str]) -> tuple[dict, list[dict[str, str]]]:
    """Runs run.py, its output shown, and returns its summary and the rows of metrics.csv."""
    command = [sys.executable, str(_RUN), *arguments, "--out", str(folder)]
    subprocess.run(command, check=True, env=os.environ | {"XDG_CACHE_HOME": str(cache)})
    with (folder / "metrics.csv").open() as file:
        return json.loads((folder / "summary.json").read_text()), list(csv.DictReader(file))


def _made_by(summary: dict) -> dict:
    return {name: summary[name] for name in ("command", "device", "versions")}


def measure_compilation(task: str, arguments: list[str]) -> tuple[dict, list[dict]]:
    """Compiles a run's program with an empty cache, then from the cache; returns what made it and a row."""
    with tempfile.TemporaryDirectory() as folder:
        measured: dict[str, Any] = {"task": task}
        for name in ("cold", "cached"):
            call = ["--task", task, "--iterations", "0", *arguments]
            summary, _ = _run(Path(folder) / name, Path(folder) / "cache", call)
            measured |= {f"{name}_compile_seconds": summary["wall_seconds"]["compile"]}
            measured |= {f"{name}_total_seconds": summary["wall_seconds"]["total"]}
    return _made_by(summary), [measured]


def measure_time_to_success(task: str, arguments: list[str]) -> tuple[dict, list[dict]]:
    """Trains by default and returns when every seed had the success rate wanted, in the physics trained in."""
    with tempfile.TemporaryDirectory() as folder:
        summary, rows = _run(Path(folder) / "run", Path(folder) / "cache", ["--task", task, *arguments])
    seconds, steps, success = (
        np.array([float(row[name] or 0.0) for row in rows]).reshape(-1, summary["seeds"])
        for name in ("seconds", "env_steps", "success_rate")
    )
    there = np.flatnonzero((success >= SUCCESS[task]).all(axis=1))
    first = there[0] if there.size else None
    return _made_by(summary), [
        {
            "task": task,
            "seeds": summary["seeds"],
            "wanted": SUCCESS[task],
            "seconds_until_every_seed": None if first is None else float(seconds[first, 0]),
            "env_steps_per_seed_until_then": None if first is None else int(steps[first, 0]),
            "train_seconds": summary["wall_seconds"]["train"],
            "compile_seconds": summary["wall_seconds"]["compile"],
            "total_seconds": summary["wall_seconds"]["total"],
            "train_env_steps_per_second": summary["env_steps_per_second"],
            "final_success_mean": summary["success_rate"]["mean"],
            "final_success_worst_seed": min(summary["success_rate"]["per_seed"]),
        }
    ]

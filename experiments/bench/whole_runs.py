"""Measures whole runs of `hgail train`, each in a separate process: compilation, and the time to a success rate."""

import csv
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hgail_jax.cli.command_line import user_cache
from hgail_jax.io.provenance import own_command

SUCCESS = {"reach": 0.98}
"""Success rate that every seed must reach, by task."""
_SUCCESS_ELSE = 0.95

_TRAIN = (sys.executable, "-m", "hgail_jax", "train")
_QUICK = ("--num-envs", "4", "--seeds", "2", "--rounds", "1")


def measure_compilation(task: str, options: Sequence[str], quick: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Compiles a run's training program three times; returns a row and its provenance.

    The totals are of whole runs without rounds, and include the compilation of the final evaluation.

    For `first` nothing is cached; MuJoCo Warp then compiles its kernels when the program first runs, so that they count
    in the total alone. For `cold` the kernels are cached, for `cached` also the program.

    Args:
      task: to train.
      options: further ones of `hgail train`.
      quick: take the smallest sizes.
    """
    arguments = ["--task", task, "--rounds", "0", *(_QUICK if quick else ()), *options]
    with tempfile.TemporaryDirectory() as name:
        folder, measured = Path(name), dict[str, Any](task=task)
        for run, programs in (("first", "of-first"), ("cold", "of-others"), ("cached", "of-others")):
            summary, _ = train(folder / run, arguments, folder / programs, folder / "kernels")
            measured[f"{run}_compile_seconds"] = summary["wall_seconds"]["compile"]
            measured[f"{run}_total_seconds"] = summary["wall_seconds"]["total"]
    return measured | _given(options), _made_by(summary)


def measure_time_to_success(task: str, options: Sequence[str], quick: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Trains by default; returns a row with the time until every seed had the success rate, and its provenance.

    See `measure_compilation` for the arguments.
    """
    arguments = ["--task", task, *(_QUICK if quick else ()), *options]
    with tempfile.TemporaryDirectory() as folder:
        summary, rows = train(Path(folder) / "run", arguments, Path(folder) / "programs")
    wanted = SUCCESS.get(task, _SUCCESS_ELSE)
    seconds, steps = first_success(rows, wanted)
    measured = {
        "task": task,
        "seeds": summary["seeds"],
        "wanted": wanted,
        "seconds_until_every_seed": seconds,
        "env_steps_per_seed_until_then": steps,
        "train_seconds": summary["wall_seconds"]["train"],
        "compile_seconds": summary["wall_seconds"]["compile"],
        "total_seconds": summary["wall_seconds"]["total"],
        "train_env_steps_per_second": summary["env_steps_per_second"],
        "final_success_mean": summary["success_rate"]["mean"],
        "final_success_worst_seed": min(summary["success_rate"]["per_seed"]),
    }
    return measured | _given(options), _made_by(summary)


def first_success(rows: list[dict[str, str]], wanted: float) -> tuple[float | None, int | None]:
    """Returns seconds and environment steps per seed at the first round with every seed at the success rate.

    Both are None if there is no such round. Seconds count from the start of the training, after compilation.

    Args:
      rows: of metrics.csv.
      wanted: the success rate.
    """
    for index in dict.fromkeys(row["round"] for row in rows):
        seeds = [row for row in rows if row["round"] == index]
        if all(float(row["success_rate"] or 0.0) >= wanted for row in seeds):
            return float(seeds[0]["seconds"]), int(seeds[0]["env_steps"])
    return None, None


def train(
    folder: Path, arguments: Sequence[str], programs: Path, kernels: Path | None = None
) -> tuple[dict[str, Any], list[dict[str, str]]]:
    """Trains in a separate process, its output shown.

    Args:
      folder: of the run.
      arguments: of `hgail train`.
      programs: the run's cache of programs.
      kernels: its cache of MuJoCo Warp's kernels; None is the user's.

    Returns:
      The run's summary, and the rows of metrics.csv, one for each round and seed.

    Raises:
      subprocess.CalledProcessError: the run failed.
    """
    environment = {name: value for name, value in os.environ.items() if name != "XLA_PYTHON_CLIENT_PREALLOCATE"}
    environment["WARP_CACHE_PATH"] = str(kernels or environment.get("WARP_CACHE_PATH") or user_cache() / "warp")
    environment["JAX_COMPILATION_CACHE_DIR"] = str(programs)
    command = [*_TRAIN, *arguments, "--out", str(folder)]
    subprocess.run(command, env=environment, check=True)
    with (folder / "metrics.csv").open() as file:
        return json.loads((folder / "summary.json").read_text()), list(csv.DictReader(file))


def _given(options: Sequence[str]) -> dict[str, str]:
    return {"options": " ".join(options)} if options else {}


def _made_by(summary: dict[str, Any]) -> dict[str, Any]:
    """Returns the provenance in a run's summary, with this process's command."""
    return {"command": own_command()} | {name: summary[name] for name in ("commit", "device", "cpu_cores", "versions")}

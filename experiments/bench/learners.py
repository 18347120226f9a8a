"""Success over environment steps and seconds: methods of this project, and JaxGCRL's learner."""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from experiments.bench.contrastive import JaxGcrlTask, train_contrastive
from experiments.bench.whole_runs import made_by, train
from experiments.bench.workload import default_substeps
from hgail_jax.defaults import platform_name

METHODS = {"hgail": "HGAIL", "gcsl": "GCSL", "ppo": "PPO"}
"""Methods of this project, and their names in the rows."""
SEEDS = 4

_NUM_ENVS = {"cpu": 256, "gpu": 1024}  # of JaxGCRL's learner
_ENOUGH = 0.98  # success rate in two tests in a row that ends its training
_QUICK_METHOD = ("--num-envs", "4", "--iterations", "1")


def method_rows(task: str, method: str, quick: bool) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Trains `SEEDS` seeds of a method by default, side by side; yields a row for each seed, and its provenance.

    A row has lists over the tests of the training: environment steps of a seed; seconds, of all seeds together,
    compilation and tests included; and success rates.
    """
    arguments = ["--task", task, "--method", method, "--seeds", str(SEEDS), *(_QUICK_METHOD if quick else ())]
    with tempfile.TemporaryDirectory() as folder:
        summary, rows = train(Path(folder) / "run", arguments, Path(folder) / "programs")
    compilation = summary["wall_seconds"]["compile"]
    for seed in range(SEEDS):
        tests = [row for row in rows if row["seed"] == str(seed) and row["success_rate"]]
        measured = {
            "task": task,
            "what": METHODS[method],
            "seed": seed,
            "env_steps": [int(row["env_steps"]) for row in tests],
            "train_seconds": [compilation + float(row["seconds"]) for row in tests],
            "success": [float(row["success_rate"]) for row in tests],
        }
        yield measured, made_by(summary)


def contrastive_rows(task: str, quick: bool, time_limit: float) -> Iterator[dict[str, Any]]:
    """Trains JaxGCRL's learner, one seed after the other; yields a row for each, see `method_rows`.

    Each ends with success, or once it has trained for `time_limit` seconds. Seconds are by its own clock, see
    `contrastive.Tested`, and each seed has the machine to itself.

    Raises:
      ImportError: JaxGCRL is not installed.
      ValueError: the task is not one of `contrastive.TASKS`.

    """
    platform = platform_name()
    num_envs = _NUM_ENVS[platform]
    learnt = JaxGcrlTask(task, "auto", default_substeps(task, platform), num_envs)
    for seed in range(1 if quick else SEEDS):
        tests: list[tuple[int, float, float]] = []

        def tested(*test: Any, tests: list = tests) -> bool:
            tests.append(test)
            solved = len(tests) > 1 and min(tests[-1][2], tests[-2][2]) >= _ENOUGH
            return quick or solved or tests[-1][1] >= time_limit

        train_contrastive(learnt, num_envs, seed, tested)
        env_steps, seconds, success = (list(column) for column in zip(*tests, strict=True))
        yield {
            "task": task,
            "what": "JaxGCRL CRL",
            "seed": seed,
            "num_envs": num_envs,
            "env_steps": env_steps,
            "train_seconds": seconds,
            "success": success,
        }

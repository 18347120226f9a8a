"""Success over environment steps and seconds: learners of this project, and those of others."""

import dataclasses
import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from experiments.bench.contrastive import JaxGcrlTask, train_contrastive
from experiments.bench.whole_runs import made_by, metrics_rows, planned, run_training
from experiments.bench.workload import default_substeps
from hgail_jax.settings.defaults import platform_name

CRL, SAC_HER = "crl", "sb3-sac-her"


@dataclasses.dataclass(frozen=True)
class OwnLearner:
    """A learner of this project."""

    what: str
    """Name in the rows."""
    arguments: tuple[str, ...]
    """Of `hgail train`."""


OWN = {
    "hgail": OwnLearner("HGAIL, TD3", ("--method", "hgail", "--learner", "td3")),
    "hgail-no-reward": OwnLearner(
        "HGAIL, TD3, no reward", ("--method", "hgail", "--learner", "td3", "--environment-reward", "0")
    ),
    "her": OwnLearner("HER, TD3", ("--method", "her")),
    "hgail-ppo": OwnLearner("HGAIL, PPO", ("--method", "hgail", "--learner", "ppo")),
    "ppo": OwnLearner("PPO", ("--method", "ppo")),
    "gcsl": OwnLearner("GCSL", ("--method", "gcsl")),
}
"""Learners of this project, by the names that `--learner` has for them."""
LEARNERS = (*OWN, CRL, SAC_HER)
"""Names of all learners; the last two are of JaxGCRL and of stable-baselines3."""
SEEDS = 4

_NUM_ENVS = {"cpu": 256, "gpu": 1024}  # of JaxGCRL's learner
_ENOUGH = 0.98  # success rate in two tests in a row that ends the training of the others' learners
_MOST_STEPS = 10_000_000
_QUICK_OWN = ("--num-envs", "4", "--iterations", "1")

Row = dict[str, Any]


def own_rows(task: str, names: Sequence[str], quick: bool, time_limit: float) -> Iterator[tuple[Row, dict[str, Any]]]:
    """Trains the named learners of `OWN`, `SEEDS` seeds side by side; yields a row for each seed, and its provenance.

    A row has lists over the tests of the training: environment steps of a seed; seconds, of all seeds together,
    compilation and tests included; and success rates. A learner ends after the round that it is in when `time_limit`
    seconds have passed since its process began. One whose settings on this task are those of another is left out.
    """
    seeds = 1 if quick else SEEDS
    shared = ["--task", task, "--seeds", str(seeds), *(_QUICK_OWN if quick else ())]
    arguments = {name: [*shared, *OWN[name].arguments] for name in names}
    trained: dict[str, str] = {}
    for name, settings in zip(names, planned(list(arguments.values())) if names else (), strict=True):
        what = OWN[name].what
        same = json.dumps({key: value for key, value in settings.items() if key != "method"}, sort_keys=True)
        if same in trained:
            print(f"left out: {what} (on {task} it is {trained[same]})")
            continue
        trained[same] = what
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / "run"
            run_training(run, arguments[name], Path(folder) / "programs", time_limit=time_limit)
            found = [{"task": task, "what": what, **row} for row in _curves(run, seeds)]
            provenance = made_by(json.loads((run / "config.json").read_text()))
        if not found:
            print(f"left out: {what} (not tested within {time_limit:g} s)")
        yield from ((row, provenance) for row in found)


def _curves(folder: Path, seeds: int) -> list[Row]:
    """Returns the tests of each seed of a run, also of one that was stopped; nothing if there were none.

    A stopped run does not tell how long it compiled. It writes config.json when it begins to, and metrics.csv anew
    after each round, with the seconds since it had compiled.
    """
    metrics = folder / "metrics.csv"
    rows = metrics_rows(folder) if metrics.exists() else []
    tests = [row for row in rows if row["success_rate"]]
    if not tests:
        return []
    until_last = metrics.stat().st_mtime - (folder / "config.json").stat().st_mtime
    compilation = until_last - float(rows[-1]["seconds"])
    return [
        {
            "seed": seed,
            "env_steps": [int(row["env_steps"]) for row in tests if row["seed"] == str(seed)],
            "train_seconds": [compilation + float(row["seconds"]) for row in tests if row["seed"] == str(seed)],
            "success": [float(row["success_rate"]) for row in tests if row["seed"] == str(seed)],
        }
        for seed in range(seeds)
    ]


class _Tests:
    """Tests of a learner that is not this project's, which end its training."""

    def __init__(self, quick: bool, time_limit: float) -> None:
        self._quick, self._time_limit = quick, time_limit
        self._tests: list[tuple[int, float, float]] = []

    def add(self, env_steps: int, seconds: float, success: float) -> bool:
        """Adds a test; returns whether it was the last: with success, or once the time is over."""
        self._tests.append((env_steps, seconds, success))
        solved = len(self._tests) > 1 and min(self._tests[-1][2], self._tests[-2][2]) >= _ENOUGH
        return self._quick or solved or seconds >= self._time_limit

    def row(self) -> Row:
        """Returns the columns of a row."""
        env_steps, seconds, success = (list(column) for column in zip(*self._tests, strict=True))
        return {"env_steps": env_steps, "train_seconds": seconds, "success": success}


def contrastive_rows(task: str, quick: bool, time_limit: float) -> Iterator[Row]:
    """Trains JaxGCRL's learner, one seed after the other; yields a row for each, see `own_rows`.

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
        tests = _Tests(quick, time_limit)
        train_contrastive(learnt, num_envs, seed, tests.add)
        yield {"task": task, "what": "JaxGCRL CRL", "seed": seed, "num_envs": num_envs, **tests.row()}


def sac_her_rows(task: str, quick: bool, time_limit: float) -> Iterator[Row]:
    """Trains stable-baselines3's SAC with HER, seed 0 alone, on this project's task on the CPU; yields its row.

    It ends as `contrastive_rows` do. The seconds are without the tests.

    Raises:
      ImportError: it is not installed, or JAX has a GPU, on which the task would run.

    """
    if platform_name() != "cpu":
        raise ImportError("it is measured on a CPU alone, with JAX_PLATFORMS=cpu")
    import stable_baselines3

    from experiments.other_trainers import Policy, make_test, sb3_sac_her  # Gymnasium comes with it

    substeps = default_substeps(task, "cpu")
    test, tests, testing = make_test(task, substeps), _Tests(quick, time_limit), 0.0
    started = time.perf_counter()

    def tested(env_steps: int, policy: Policy) -> bool:
        nonlocal testing
        now = time.perf_counter()
        enough = tests.add(env_steps, now - started - testing, test(policy))
        testing += time.perf_counter() - now
        return enough

    sb3_sac_her(tested, _MOST_STEPS, task=task, substeps=substeps)
    what = f"stable-baselines3 {stable_baselines3.__version__} SAC and HER"
    yield {"task": task, "what": what, "seed": 0, **tests.row()}

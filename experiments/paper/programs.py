"""Trains settings and seeds side by side: those that share their shapes and counts as one compiled program."""

import contextlib
import dataclasses
import functools
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

import envs
from experiments.paper.studies import Trial
from hgail_jax.distributed.seeds import (
    SeedsStep,
    compile_train_step,
    evaluate_seeds,
    evaluation_episodes,
    init_sweep,
    seed_keys,
    split_sweep,
)
from hgail_jax.samples import Samples
from hgail_jax.state import TrainState
from hgail_jax.train import EVALUATE, env_steps, schedule
from hgail_jax.trainer.checkpoint import Checkpoints

_CHECKPOINT_SECONDS = 60.0


def programs(trials: Iterable[Trial]) -> list[list[Trial]]:
    """Returns the trials in groups that one compiled program trains, in the order in which each group first comes."""
    groups: dict[Any, list[Trial]] = {}
    for trial in trials:
        groups.setdefault((trial.config, trial.setting.steps, trial.demonstrations_sha256), []).append(trial)
    return list(groups.values())


def train_program(
    env: envs.GoalEnv, trials: list[Trial], demonstrations: Samples | None, folder: Path, stop: threading.Event
) -> list[dict] | None:
    """Trains and evaluates all seeds of trials that share a program.

    Args:
      env: the task.
      trials: of one of `programs`.
      demonstrations: see `init_state`.
      folder: of its checkpoints; where there is one, the training goes on from it.
      stop: once it is set, the training ends with the round that it is in, and a checkpoint.

    Returns:
      What came of each trial: lists over the rounds evaluated and seeds, and the seconds that the program took. None if
      it was stopped.

    Raises:
      OSError: a checkpoint cannot be written.

    """
    started = time.perf_counter()
    step = _compile(env, trials, demonstrations)
    compile_seconds = time.perf_counter() - started
    progress = _Progress(_init(env, trials, demonstrations))
    with Checkpoints(folder, {"trials": [trial.identity() for trial in trials]}) as checkpoints:
        progress.restore(checkpoints)
        _train(trials, step, progress, checkpoints, stop)
    if stop.is_set():
        return None
    trained = time.perf_counter()
    final = evaluate_seeds(env, trials[0].config, progress.states, trials[0].evaluation_episodes)
    evaluation_seconds = time.perf_counter() - trained
    seconds = {"compile": compile_seconds, "train": progress.seconds, "evaluation": evaluation_seconds}
    return _results(env, trials, progress, {"settings": len(trials), "seconds": seconds}, vars(final))


def _results(env: envs.GoalEnv, trials: list[Trial], progress: "_Progress", program: dict, final: dict) -> list[dict]:
    """Takes what came of a program apart into its trials."""
    worst = {name: max(max(row[name]) for row in progress.rows) for name in ("dropped", "overflow")}
    if worst["overflow"] > 0:
        raise OverflowError("the simulation ran out of room for contacts")
    phases = trials[0].phases()
    evaluated = np.flatnonzero(phases[:, -1] == EVALUATE)
    measured = {
        name: np.stack([progress.rows[index][name] for index in evaluated], axis=1)
        for name in ("success", "distance_l1")
    }
    final, curves, diverged = split_sweep((final, measured, _diverged(progress.states)), len(trials))
    steps = env_steps(env, trials[0].config, phases).cumsum()[evaluated]
    return [
        {
            "rounds": evaluated.tolist(),
            "env_steps": steps.tolist(),
            "success": curves["success"][index].T.tolist(),
            "distance_l1": curves["distance_l1"][index].T.tolist(),
            "final": {name: values[index].tolist() for name, values in final.items()},
            "evaluation_episodes": evaluation_episodes(trials[0].config, trials[0].evaluation_episodes),
            "diverged_seeds": int(diverged[index].sum()),
            "program": program | worst,
        }
        for index in range(len(trials))
    ]


def time_sweep(env: envs.GoalEnv, trials: list[Trial]) -> dict:
    """Trains trials that share a program at once, then one after another, and returns the seconds of both.

    Both compile once, apart from the training, and neither is evaluated in the end.
    """

    def measure(groups: list[list[Trial]]) -> dict[str, float]:
        started = time.perf_counter()
        step = _compile(env, groups[0], None)
        compiled = time.perf_counter()
        for group in groups:
            _train(group, step, _Progress(_init(env, group, None)))
        return {"compile": compiled - started, "train": time.perf_counter() - compiled}

    together = measure([trials])
    in_turn = measure([[trial] for trial in trials])
    return {
        "settings": [trial.setting.name for trial in trials],
        "seeds": trials[0].seeds,
        "one_program_seconds": together,
        "one_after_another_seconds": in_turn,
        "ratio": in_turn["train"] / together["train"],
    }


def _init(env: envs.GoalEnv, trials: list[Trial], demonstrations: Samples | None) -> TrainState:
    settings = [trial.hyperparameters for trial in trials]
    return init_sweep(env, trials[0].config, settings, seed_keys(0, trials[0].seeds), demonstrations)


def _compile(env: envs.GoalEnv, trials: list[Trial], demonstrations: Samples | None) -> SeedsStep:
    states = jax.eval_shape(functools.partial(_init, env, trials, demonstrations))
    return compile_train_step(env, trials[0].config, states, schedule(trials[0].config)[0])


@dataclasses.dataclass
class _Progress:
    """A program between two rounds."""

    states: TrainState
    rows: list[dict[str, list[float]]] = dataclasses.field(default_factory=list)
    """What each round measured of each state; success and distance only where it was evaluated."""
    seconds: float = 0.0
    """Time spent in the rounds."""

    def restore(self, checkpoints: Checkpoints) -> None:
        """Goes on from the last checkpoint, if there is one."""
        found = checkpoints.restore(self.states)
        if found is not None:
            self.states, self.rows, self.seconds = found.state, found.record["rows"], found.record["seconds"]

    def save(self, checkpoints: Checkpoints) -> None:
        """Saves a checkpoint, unless a setting has diverged: then the program starts anew if it is stopped."""
        record = {"rows": self.rows, "seconds": self.seconds}
        with contextlib.suppress(FloatingPointError):
            checkpoints.save(len(self.rows), self.states, record, score=(len(self.rows),))


def _train(
    trials: list[Trial],
    step: SeedsStep,
    progress: _Progress,
    checkpoints: Checkpoints | None = None,
    stop: threading.Event | None = None,
) -> None:
    """Takes `progress` through the rounds left, or until `stop`, with a checkpoint now and then."""
    phases = trials[0].phases()
    started, saved = time.perf_counter() - progress.seconds, time.perf_counter()
    label = f"{len(trials)} settings × {trials[0].seeds} seeds"
    for row in tqdm(phases[len(progress.rows) :], initial=len(progress.rows), total=len(phases), desc=label):
        progress.states, metrics = step(progress.states, row)
        measured = {"dropped": metrics.dropped, "overflow": metrics.overflow}
        if row[-1] == EVALUATE:
            measured |= {name: getattr(metrics.evaluation, name) for name in ("success", "distance_l1")}
        progress.rows.append({name: np.asarray(values).tolist() for name, values in measured.items()})
        progress.seconds = time.perf_counter() - started
        stopping = stop is not None and stop.is_set()
        if checkpoints is not None and (stopping or time.perf_counter() - saved > _CHECKPOINT_SECONDS):
            progress.save(checkpoints)
            saved = time.perf_counter()
        if stopping:
            break


def _diverged(states: TrainState) -> np.ndarray:
    """Returns whether a network of each state is not finite, booleans `[settings * seeds]`."""
    leaves = jax.tree.leaves((states.actor_critic, states.discriminator))
    return ~np.all([np.isfinite(leaf).reshape(len(leaf), -1).all(axis=1) for leaf in leaves], axis=0)

"""Trains trials, those with the same shapes and counts side by side in one compiled program."""

import threading
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np

import hgail_envs
from experiments.paper.trials import Trial
from hgail_jax.samples import Samples
from hgail_jax.seeds import evaluate_seeds, split_sweep
from hgail_jax.terminal import StatusLine
from hgail_jax.train import EVALUATE
from hgail_jax.trainer.checkpoint import Checkpoints
from hgail_jax.trainer.loop import Program, Progress, SavingPolicy, begin, train

_CHECKPOINT_SECONDS = 60.0


def group_by_program(trials: Iterable[Trial]) -> list[list[Trial]]:
    """Groups trials that one compiled program can train, in order of first appearance."""
    groups: dict[Any, list[Trial]] = {}
    for trial in trials:
        options = tuple(sorted(trial.task_options.items()))
        shared = (trial.config, options, trial.evaluate_every, trial.seeds, trial.demonstrations_sha256)
        groups.setdefault(shared, []).append(trial)
    return list(groups.values())


def make_program(env: hgail_envs.GoalEnv, trials: list[Trial], demonstrations: Samples | None) -> Program:
    """Returns the program that trains a group of `group_by_program`."""
    return Program(
        env=env,
        config=trials[0].config,
        settings=tuple(trial.hyperparameters for trial in trials),
        seeds=len(trials[0].seeds),
        first_seed=trials[0].seeds.start,
        demonstrations=demonstrations,
        evaluate_every=trials[0].evaluate_every,
    )


def train_program(
    env: hgail_envs.GoalEnv, trials: list[Trial], demonstrations: Samples | None, folder: Path, stop: threading.Event
) -> list[dict[str, Any]] | None:
    """Trains and evaluates all seeds of a group of trials in one program.

    Args:
      env: the task.
      trials: a group of `group_by_program`.
      demonstrations: see `init_state`.
      folder: of checkpoints; the training resumes from the newest.
      stop: once set, the training saves a checkpoint and ends after the present round.

    Returns:
      The results of each trial: lists over evaluated rounds and seeds, and the program's seconds. None if stopped.

    Raises:
      OSError: a checkpoint cannot be written.
      OverflowError: the simulation had more contacts than its buffers hold.
      FloatingPointError: no seed's update, or no episode's simulation, was finite in a round.
    """
    program = make_program(env, trials, demonstrations)
    started = time.perf_counter()
    with ThreadPoolExecutor(1) as background, StatusLine("compiling the training program"):
        preparing = background.submit(env.prepare)  # must be done with the device before the first step
        step = program.compile()
        preparing.result()
    seconds = {"compile": time.perf_counter() - started}
    with Checkpoints(folder, {"trials": [trial.identity() for trial in trials]}) as checkpoints:
        progress = begin(program, program.init(), checkpoints.restore(jax.eval_shape(program.init)))
        train(program, step, progress, checkpoints, SavingPolicy(seconds=_CHECKPOINT_SECONDS), stop)
    if stop.is_set():
        return None
    started = time.perf_counter()
    with StatusLine("evaluating the policies in the reference physics"):
        final = evaluate_seeds(env, program.config, progress.states, trials[0].evaluation_episodes)
    seconds |= {"train": progress.seconds, "evaluation": time.perf_counter() - started}
    return _results(trials, program, progress, vars(final), seconds)


def _results(
    trials: list[Trial], program: Program, progress: Progress, final: dict[str, Any], seconds: dict[str, float]
) -> list[dict[str, Any]]:
    """Splits a program's results into those of its trials."""
    evaluated = np.flatnonzero(program.phases()[:, -1] == EVALUATE)
    columns = {"success": "success_rate", "distance_l1": "distance_l1"}
    curves = {
        name: np.stack([np.array(progress.history[index][column], float) for index in evaluated], axis=1)
        for name, column in columns.items()
    }
    rates = {
        name: np.array([row[name] for row in progress.history], float) for name in ("dropped_rate", "diverged_rate")
    }
    diverged = np.nan_to_num(rates["diverged_rate"]).max(axis=0) > 0
    final, curves, diverged = split_sweep((final, curves, diverged), len(trials))
    worst_dropped = float(np.nan_to_num(rates["dropped_rate"]).max())
    return [
        {
            "curves": {
                "rounds": evaluated.tolist(),
                "env_steps": program.env_steps()[evaluated].tolist(),
                "success": curves["success"][index].T.tolist(),
                "distance_l1": curves["distance_l1"][index].T.tolist(),
            },
            "final": {name: np.asarray(values)[index].tolist() for name, values in final.items()},
            "diverged_seeds": int(diverged[index].sum()),
            "program": {"settings": len(trials), "seconds": seconds, "dropped": worst_dropped},
        }
        for index in range(len(trials))
    ]


def time_sweep(env: hgail_envs.GoalEnv, trials: list[Trial]) -> dict[str, Any]:
    """Returns the seconds of training a group of trials side by side, and of training them one after another.

    Both compile once, timed apart, and skip the final evaluation.
    """

    def measure(groups: list[list[Trial]]) -> dict[str, float]:
        started = time.perf_counter()
        step = make_program(env, groups[0], None).compile()
        compiled = time.perf_counter()
        for group in groups:
            program = make_program(env, group, None)
            train(program, step, begin(program, program.init()))
        return {"compile": compiled - started, "train": time.perf_counter() - compiled}

    together = measure([trials])
    in_turn = measure([[trial] for trial in trials])
    return {
        "settings": [trial.setting.name for trial in trials],
        "seeds": list(trials[0].seeds),
        "one_program_seconds": together,
        "one_after_another_seconds": in_turn,
        "ratio": in_turn["train"] / together["train"],
    }

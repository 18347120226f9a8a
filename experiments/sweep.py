"""Trains settings and seeds side by side: those that share their shapes and counts as one compiled program."""

import functools
import sys
import time
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np
from studies import Trial
from tqdm import tqdm

import envs
from hgail_jax.parallel import (
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
from hgail_jax.train import RoundMetrics, env_steps, schedule


def programs(trials: Iterable[Trial]) -> list[list[Trial]]:
    """Returns the trials in groups that one compiled program trains, in the order in which each group first comes."""
    groups: dict[Any, list[Trial]] = {}
    for trial in trials:
        groups.setdefault((trial.config, trial.demonstrations_sha256), []).append(trial)
    return list(groups.values())


def train_program(env: envs.GoalEnv, trials: list[Trial], demonstrations: Samples | None) -> list[dict]:
    """Trains and evaluates all seeds of trials that share a program.

    Args:
      env: the task.
      trials: of one of `programs`.
      demonstrations: see `init_state`.

    Returns:
      What came of each trial: lists over rounds `[rounds + 1]` and seeds, and the seconds that the program took.

    """
    started = time.perf_counter()
    step = _compile(env, trials, demonstrations)
    compiled = time.perf_counter()
    states, curves, worst = _train(env, trials, demonstrations, step)
    trained = time.perf_counter()
    states, final = evaluate_seeds(step, trials[0].config, states, trials[0].evaluation_episodes)
    seconds = {"compile": compiled - started, "train": trained - compiled, "evaluation": time.perf_counter() - trained}
    if worst["overflow"] > 0:
        print("the simulation ran out of room for contacts: these results are wrong", file=sys.stderr)
    diverged = split_sweep(_diverged(states), len(trials))
    final, curves = split_sweep((vars(final), curves), len(trials))
    steps = env_steps(env, trials[0].config, schedule(trials[0].config)).cumsum()
    return [
        {
            "env_steps": steps.tolist(),
            "success": curves["success"][index].T.tolist(),
            "distance_l1": curves["distance_l1"][index].T.tolist(),
            "final": {name: values[index].tolist() for name, values in final.items()},
            "evaluation_episodes": evaluation_episodes(trials[0].config, trials[0].evaluation_episodes),
            "diverged_seeds": int(diverged[index].sum()),
            "program": {"settings": len(trials), "seconds": seconds} | worst,
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
            _train(env, group, None, step)
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


def _train(env: envs.GoalEnv, trials: list[Trial], demonstrations: Samples | None, step: SeedsStep):
    """Returns the states, the curves `[settings * seeds, rounds + 1]`, and the worst shares of episodes spoilt."""
    states, measured = _init(env, trials, demonstrations), []
    for phases in tqdm(schedule(trials[0].config), unit="round", desc=f"{len(trials)} × {trials[0].seeds}"):
        states, metrics = step(states, phases)
        measured.append(jax.tree.map(np.asarray, metrics))
    rounds: RoundMetrics = jax.tree.map(lambda *values: np.stack(values, axis=1), *measured)
    curves = {name: np.asarray(getattr(rounds.evaluation, name)) for name in ("success", "distance_l1")}
    return states, curves, {name: float(np.max(getattr(rounds, name))) for name in ("dropped", "overflow")}


def _diverged(states: TrainState) -> np.ndarray:
    """Returns whether a network of each state is not finite, booleans `[settings * seeds]`."""
    leaves = jax.tree.leaves((states.actor_critic, states.discriminator))
    return ~np.all([np.isfinite(leaf).reshape(len(leaf), -1).all(axis=1) for leaf in leaves], axis=0)

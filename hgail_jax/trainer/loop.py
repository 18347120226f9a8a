"""Trains the seeds of a run round by round, with checkpoints, and writes the results."""

import dataclasses
import threading
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from tqdm import tqdm

import envs
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.distributed.seeds import (
    SeedsStep,
    compile_train_step,
    evaluate_seeds,
    evaluation_episodes,
    init_seeds,
    seed_keys,
)
from hgail_jax.distributed.sharding import any_process, collect, from_first_process, spread
from hgail_jax.io.demonstrations import Demonstrations
from hgail_jax.io.files import write_csv
from hgail_jax.io.policy import from_state, save_policy
from hgail_jax.state import TrainState
from hgail_jax.train import MEASURED_BY, RoundMetrics, env_steps, schedule
from hgail_jax.trainer.checkpoint import Checkpoint, Checkpoints
from hgail_jax.trainer.curves import draw_curves


@dataclasses.dataclass(frozen=True)
class Run:
    """Everything that decides what a run computes, checked and worked out."""

    task: str
    method: str
    seeds: int
    first_seed: int
    env: envs.GoalEnv
    task_options: dict[str, Any]
    """The options of its own that the task was given."""
    config: Config
    hyperparameters: Hyperparameters
    evaluation_episodes: int
    """Episodes per seed that the final evaluation has at least."""
    checkpoint_every: int
    """Rounds from one checkpoint to the next."""
    mesh: Mesh
    """The devices to train on; what is computed does not depend on them."""
    demonstrations: Demonstrations | None = None
    """Where the method learns from any."""

    def identity(self) -> dict:
        """Returns what a run that resumes another must share with it."""
        return {
            **{name: getattr(self, name) for name in ("task", "method", "seeds", "first_seed")},
            "physics": {name: getattr(self.env, name, None) for name in ("impl", "substeps")},
            "task_options": self.task_options,
            "config": dataclasses.asdict(self.config),
            "hyperparameters": dataclasses.asdict(self.hyperparameters),
            "demonstrations": None if self.demonstrations is None else self.demonstrations.sha256,
        }

    def init(self) -> TrainState:
        """Returns the untrained states, with an axis over seeds."""
        keys = seed_keys(self.first_seed, self.seeds)
        given = None if self.demonstrations is None else self.demonstrations.samples(self.env)
        return init_seeds(self.env, self.config, self.hyperparameters, keys, given)


@dataclasses.dataclass
class Progress:
    """A run between two rounds."""

    states: TrainState
    rows: list[dict]
    """Rows of metrics.csv so far, one per seed and round."""
    rounds: int = 0
    """Rounds done."""
    seconds: float = 0.0
    """Time spent in them."""


def train(
    run: Run, folder: Path, checkpoints: Checkpoints, restored: Checkpoint | None, stop: threading.Event
) -> dict | None:
    """Trains and evaluates all seeds and writes every file but the summary into `folder`.

    Args:
      run: what to train.
      folder: there already.
      checkpoints: of this run; the states are saved there as it goes.
      restored: where to go on from, or None to begin.
      stop: once it is set, the training ends with the round that it is in, and a checkpoint.

    Returns:
      The summary, or None if it was stopped.

    Raises:
      FloatingPointError: a loss or the state is not finite; the last checkpoint is from before that.
      OverflowError: the simulation ran out of room for contacts; the last checkpoint is from before that.
      OSError: something cannot be written.

    """
    phases = schedule(run.config)
    steps = env_steps(run.env, run.config, phases).cumsum()
    compile_started = time.perf_counter()
    print("compiling ...", flush=True)
    # From shapes alone, so that a run that goes on compiles what a run that begins does.
    train_step = compile_train_step(run.env, run.config, jax.eval_shape(run.init), phases[0], run.mesh)
    compile_seconds = time.perf_counter() - compile_started
    progress = _begin(run, restored)
    write_csv(folder / "metrics.csv", progress.rows)

    with checkpoints:
        _train_rounds(run, folder, checkpoints, progress, train_step, stop)
    if _stopped(stop):
        return None
    started = time.perf_counter()
    print("compiling and running the final evaluation ...", flush=True)
    final = evaluate_seeds(run.env, run.config, progress.states, run.evaluation_episodes, run.mesh)
    timing = {
        "compile": compile_seconds,
        "train": progress.seconds,
        "evaluation": time.perf_counter() - started,
    }
    write_results(run, folder, collect(progress.states), progress.rows)
    return summarize(run, final, int(steps[-1]), timing)


def _begin(run: Run, restored: Checkpoint | None) -> Progress:
    """Returns where the training starts, on the devices. Of several processes the first alone may have a checkpoint."""
    progress = Progress(run.init(), [])
    if restored is not None:
        progress = Progress(restored.state, restored.record["rows"], restored.rounds, restored.record["seconds"])
    progress.rounds = int(from_first_process(np.array(progress.rounds)))
    progress.seconds = float(from_first_process(np.array(progress.seconds)))
    progress.states = spread(from_first_process(progress.states), run.mesh)
    return progress


def _stopped(stop: threading.Event) -> bool:
    """Returns whether any process is to stop, and sets `stop` then, so that all of them do."""
    if any_process(stop.is_set()):
        stop.set()
    return stop.is_set()


def _train_rounds(
    run: Run, folder: Path, checkpoints: Checkpoints, progress: Progress, step: SeedsStep, stop: threading.Event
) -> None:
    """Takes `progress` through the rounds left, or until `stop`; it ends with a checkpoint."""
    phases = schedule(run.config)
    steps = env_steps(run.env, run.config, phases).cumsum()
    started = time.perf_counter() - progress.seconds
    with tqdm(total=len(phases), initial=progress.rounds, unit="round", desc="training") as bar:
        while progress.rounds < len(phases) and not _stopped(stop):
            index = progress.rounds
            progress.states, measured = step(progress.states, phases[index])
            metrics: RoundMetrics = jax.tree.map(np.asarray, measured)
            refuse_divergence(run, index, phases[index], metrics)
            progress.seconds = time.perf_counter() - started
            progress.rows += metrics_rows(run, index, steps[index], progress.seconds, metrics)
            progress.rounds = index + 1
            write_csv(folder / "metrics.csv", progress.rows)
            if progress.rounds % run.checkpoint_every == 0:
                _save(checkpoints, progress)
            reached = metrics.evaluation
            bar.update()
            bar.set_postfix_str(
                f"success {np.mean(reached.success):.3f}, distance {np.mean(reached.distance_l2):.3f} m,"
                f" {steps[index] * run.seeds / progress.seconds:,.0f} env steps/s"
            )
    if checkpoints.saved != progress.rounds:
        _save(checkpoints, progress)


def _save(checkpoints: Checkpoints, progress: Progress) -> None:
    last = [row for row in progress.rows if row["round"] == progress.rounds - 1]
    success, distance = (np.mean([row[name] for row in last] or [0.0]) for name in ("success_rate", "distance_l1"))
    record = {"rows": progress.rows, "seconds": progress.seconds}
    checkpoints.save(progress.rounds, collect(progress.states), record, score=(success, -distance))


def refuse_divergence(run: Run, index: int, phases: np.ndarray, metrics: RoundMetrics) -> None:
    """Raises an error if the round `index` cannot be trusted.

    Raises:
      FloatingPointError: what it measured, `[seeds]` each, is not finite.
      OverflowError: the simulation left out contacts.

    """
    measured = {
        name: values for name, values in vars(metrics.update).items() if np.isin(phases, MEASURED_BY[name]).any()
    }
    if np.any(metrics.overflow):
        raise OverflowError(f"the simulation ran out of room for contacts in round {index}")
    for name, values in (measured | vars(metrics.evaluation)).items():
        seeds = run.first_seed + np.flatnonzero(~np.isfinite(values))
        if seeds.size:
            raise FloatingPointError(f"{name} of seed {', '.join(map(str, seeds))} is not finite in round {index}")


def metrics_rows(run: Run, index: int, steps: int, seconds: float, metrics: RoundMetrics) -> list[dict]:
    """Returns the rows of metrics.csv for the round `index`, one per seed; what it did not measure is None."""
    columns = {
        "success_rate": metrics.evaluation.success,
        "achieved_rate": metrics.evaluation.achieved,
        "success_rate_l1": metrics.evaluation.success_l1,
        "distance_l1": metrics.evaluation.distance_l1,
        "distance_l2": metrics.evaluation.distance_l2,
        "training_achieved_rate": metrics.training.achieved,
        "dropped_rate": metrics.dropped,
        **vars(metrics.update),
    }
    return [
        {"seed": run.first_seed + seed, "round": index, "env_steps": int(steps), "seconds": round(seconds, 3)}
        | {name: float(values[seed]) if np.isfinite(values[seed]) else None for name, values in columns.items()}
        for seed in range(run.seeds)
    ]


def write_results(run: Run, folder: Path, states: TrainState, rows: list[dict]) -> None:
    """Writes the policies and the curves."""
    (folder / "policies").mkdir(exist_ok=True)
    for index in range(run.seeds):
        policy = from_state(run.task, run.env, jax.tree.map(lambda leaf, i=index: leaf[i], states))
        save_policy(folder / "policies" / f"seed-{run.first_seed + index}.npz", policy)
    title = f"{run.method} on {run.task}: {run.seeds} seeds, {run.config.num_envs} environments each"
    steps, success, distance = (
        np.array([row[name] for row in rows]).reshape(-1, run.seeds)
        for name in ("env_steps", "success_rate", "distance_l1")
    )
    draw_curves(folder / "curves.png", title, steps[:, 0], success, distance)


def summarize(run: Run, final: envs.EpisodeMetrics, steps: int, timing: dict) -> dict:
    """Returns summary.json's content, less what made it and the total time."""

    def over_seeds(measured: jax.Array | float) -> dict:
        values = np.asarray(measured)
        return {"mean": float(values.mean()), "std": float(values.std()), "per_seed": values.tolist()}

    return {
        "task": run.task,
        "method": run.method,
        "seeds": run.seeds,
        "mesh": dict(run.mesh.shape),
        "success_rate": over_seeds(final.success),
        "achieved_rate": over_seeds(final.achieved),
        "success_rate_l1": over_seeds(final.success_l1),
        "distance_l1": over_seeds(final.distance_l1),
        "distance_l2": over_seeds(final.distance_l2),
        "evaluation_episodes_per_seed": evaluation_episodes(run.config, run.evaluation_episodes),
        "env_steps_per_seed": steps,
        "env_steps_per_second": steps * run.seeds / timing["train"],
        "wall_seconds": timing,
    }

"""The training loop of runs and sweeps: one compiled program, round by round, with checkpoints."""

import dataclasses
import threading
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from tqdm import tqdm

import hgail_envs
from hgail_envs.validation import counted
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.devices.sharding import (
    any_process,
    check_replicas,
    from_first_process,
    json_from_first_process,
    replicate,
    shard,
)
from hgail_jax.samples import Samples
from hgail_jax.seeds import SeedsStep, compile_train_step, init_sweep, seed_keys
from hgail_jax.state import TrainState
from hgail_jax.terminal import StatusLine
from hgail_jax.train import EVALUATE, SKIP, RoundMetrics, check_metrics, env_steps, phase_table
from hgail_jax.trainer.checkpoint import Checkpoint, Checkpoints


@dataclasses.dataclass(frozen=True)
class Program:
    """Settings of the hyperparameters and seeds that one compiled program trains side by side.

    Its states and metrics have an axis over settings times seeds, the seeds within a setting; see `split_sweep`.
    """

    env: hgail_envs.GoalEnv
    config: Config
    settings: tuple[Hyperparameters, ...]
    seeds: int
    first_seed: int = 0
    demonstrations: Samples | None = None
    mesh: Mesh | None = None
    """Devices to train on; None is one."""
    evaluate_every: int = 1
    """Rounds from one evaluation to the next; the last round always has one."""

    def phases(self) -> np.ndarray:
        """Returns the phases of each round, `[rounds + 1, phases]`, without the evaluations that are left out."""
        rows = phase_table(self.config)
        rows[np.arange(len(rows)) % self.evaluate_every > 0, -1] = SKIP
        rows[-1, -1] = EVALUATE
        return rows

    def env_steps(self) -> np.ndarray:
        """Returns the environment steps that a seed has learnt from after each round, `[rounds + 1]`."""
        return env_steps(self.env, self.config, self.phases()).cumsum()

    def init(self) -> TrainState:
        """Returns the untrained states."""
        keys = seed_keys(self.first_seed, self.seeds)
        return init_sweep(self.env, self.config, self.settings, keys, self.demonstrations)

    def compile(self) -> SeedsStep:
        """Compiles the training step, from shapes alone, so that a resumed run compiles the same program."""
        return compile_train_step(self.env, self.config, jax.eval_shape(self.init), self.phases()[0], self.mesh)

    def label(self, index: int) -> str:
        """Names one of the settings times seeds."""
        setting, seed = divmod(index, self.seeds)
        of_setting = f" of setting {setting}" if len(self.settings) > 1 else ""
        return f"seed {self.first_seed + seed}{of_setting}"


@dataclasses.dataclass
class Progress:
    """A program between two rounds."""

    states: TrainState
    history: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    """Record of each round done, see `round_record`."""
    seconds: float = 0.0
    """Time spent in them."""
    saved: int = 0
    """Rounds done in the checkpoint saved last or restored; in every process the same."""
    diverged: set[int] = dataclasses.field(default_factory=set)
    """Settings times seeds with an update that was not finite, by index."""

    @property
    def rounds(self) -> int:
        """Rounds done."""
        return len(self.history)

    def score(self) -> tuple[float, float] | None:
        """Returns success rate and negative distance in the last round; None if it had no evaluation."""
        last = self.history[-1]
        success, distance = (_mean(last[name]) for name in ("success_rate", "distance_l1"))
        return None if success is None or distance is None else (success, -distance)


@dataclasses.dataclass(frozen=True)
class SavingPolicy:
    """Rounds and seconds that must both have passed since the last checkpoint before the next."""

    rounds: int = 1
    seconds: float = 0.0
    most: float = 1.0
    """Fraction of the time that saving may take: after a checkpoint the next waits until this is kept."""


def train(
    program: Program,
    step: SeedsStep,
    progress: Progress,
    checkpoints: Checkpoints | None = None,
    saving: SavingPolicy | None = None,
    stop: threading.Event | None = None,
    after_round: Callable[[Progress], None] = lambda progress: None,
) -> None:
    """Runs the rounds that are left, by `step` from `Program.compile`, and changes `progress`, from `begin`.

    Checkpoints are saved as `saving` spaces them, by default after each round, and at the end. Once `stop` is set in
    any process, the training ends with the round that it is in. `after_round` is called before a round is saved. A seed
    whose update is not finite is left as it was before that update, and continues; the round's record counts it.

    Raises:
      OverflowError: the simulation ran out of room for contacts; the last checkpoint is from before that.
      FloatingPointError: no seed's update was finite in a round, or no episode's simulation; likewise.
      ReplicaError: devices that should hold the same numbers do not; likewise.
      OSError: a checkpoint cannot be written.
    """
    phases, steps, saving = program.phases(), program.env_steps(), saving or SavingPolicy()
    stop = stop or threading.Event()
    if progress.rounds == len(phases):  # no round is left, so that no status line is shown
        return
    begun, done = time.perf_counter(), max(progress.rounds, 1)
    started, saved, cost = begun - progress.seconds, begun, 0.0
    with StatusLine(_beginning(program, progress)) as line:
        while progress.rounds < len(phases) and not is_stopped(stop):
            index = progress.rounds
            progress.states, measured = step(progress.states, phases[index])
            _record(progress, measured, int(steps[index]), started)
            after_round(progress)
            wait = max(saving.seconds, cost / saving.most - cost)
            if progress.rounds % saving.rounds == 0 and time.perf_counter() - saved >= wait:
                saving_from = time.perf_counter()
                save(checkpoints, progress)
                saved = time.perf_counter()
                cost = saved - saving_from
            now, timed = time.perf_counter(), progress.rounds - done
            if not index:  # which only pre-trains or fills a buffer; it says nothing about the other rounds
                begun = now
            left = (now - begun) / timed * (len(phases) - progress.rounds) if timed else None
            line.show(_status(program, progress), left, log=phases[index, -1] == EVALUATE)
    save(checkpoints, progress)


def begin(program: Program, untrained: TrainState, restored: Checkpoint | None = None) -> Progress:
    """Returns the progress to start from, on its devices; the first of several processes has `restored` for all."""
    progress = Progress(untrained)
    if restored is not None:
        progress = Progress(restored.state, restored.history, restored.record["seconds"])
    progress.history, progress.seconds = json_from_first_process([progress.history, progress.seconds])
    progress.saved = progress.rounds
    progress.diverged = set().union(*map(_diverged, progress.history))
    states = from_first_process(progress.states)
    progress.states = states if program.mesh is None else shard(states, program.mesh)
    return progress


def save(checkpoints: Checkpoints | None, progress: Progress) -> None:
    """Saves a checkpoint, unless the one saved last is of the same round."""
    if checkpoints is None or progress.saved == progress.rounds:
        return
    check_replicas(progress.states)
    record, states = {"seconds": progress.seconds}, replicate(progress.states)
    checkpoints.save(progress.rounds, states, record, progress.score(), progress.history)
    progress.saved = progress.rounds


def is_stopped(stop: threading.Event) -> bool:
    """Returns whether `stop` is set in any process, and sets it in all of them then."""
    if any_process(stop.is_set()):
        stop.set()
    return stop.is_set()


def round_record(metrics: RoundMetrics, index: int, steps: int, seconds: float) -> dict[str, Any]:
    """Returns the measurements of a round: numbers, and lists over settings times seeds; None if not measured."""
    columns = {
        "success_rate": metrics.evaluation.success,
        "achieved_rate": metrics.evaluation.achieved,
        "success_rate_l1": metrics.evaluation.success_l1,
        "distance_l1": metrics.evaluation.distance_l1,
        "distance_l2": metrics.evaluation.distance_l2,
        "training_achieved_rate": metrics.training.achieved,
        "dropped_rate": metrics.dropped,
        "diverged_rate": metrics.diverged,
        **metrics.update,
    }
    return {"round": index, "env_steps": steps, "seconds": round(seconds, 3)} | {
        name: [float(value) if np.isfinite(value) else None for value in np.asarray(values)]
        for name, values in columns.items()
    }


def diverged_seeds(program: Program, progress: Progress) -> list[str]:
    """Returns the names of the seeds with an update that was not finite."""
    return [program.label(index) for index in sorted(progress.diverged)]


def _diverged(record: dict[str, Any]) -> set[int]:
    return {index for index, rate in enumerate(record["diverged_rate"]) if rate}


def _record(progress: Progress, measured: RoundMetrics, steps: int, started: float) -> None:
    """Waits for the measurements of a round and adds its record, unless its results are wrong."""
    index, metrics = progress.rounds, jax.tree.map(np.asarray, measured)
    try:
        check_metrics(metrics)
    except (OverflowError, FloatingPointError) as error:
        raise type(error)(f"{error} in round {index}") from None
    progress.seconds = time.perf_counter() - started
    progress.history.append(round_record(metrics, index, steps, progress.seconds))
    progress.diverged |= _diverged(progress.history[-1])


def _beginning(program: Program, progress: Progress) -> str:
    """Returns the status until the first round is done; round 0 is the pre-training."""
    count = len(program.settings)
    settings = f" of {count} settings × {counted(program.seeds, 'seed')}" if count > 1 else ""
    kernels = ", which builds physics kernels" if getattr(program.env, "impl", None) == "warp" else ""
    return f"round {progress.rounds}/{program.config.rounds}{settings}{kernels}"


def _status(program: Program, progress: Progress) -> str:
    """Returns the status after a round: with the time, even in hours, it fits a terminal's line."""
    last = progress.history[-1]
    success = _mean(last["success_rate"])
    rate = last["env_steps"] * program.seeds * len(program.settings) / progress.seconds
    said = [f"round {last['round']}/{program.config.rounds}"]
    said += [] if success is None else [f"success {success:.3f}"]
    said += [f"{len(progress.diverged)} diverged"] if progress.diverged else []
    said += [f"{tqdm.format_sizeof(rate)} env steps/s"] if rate else []
    return ", ".join(said)


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None

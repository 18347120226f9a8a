"""The trainer: opens a run's folder, trains, evaluates and writes what came of it."""

import contextlib
import dataclasses
import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from types import TracebackType
from typing import Any, Self, cast

import jax

from hgail_envs import GoalEnv
from hgail_envs.randomized import RandomizedEnv
from hgail_jax.defaults import platform_name
from hgail_jax.devices.processes import silent_but_first
from hgail_jax.devices.sharding import any_process, is_first_process, replicate
from hgail_jax.io.files import remove_partial_files, write_json
from hgail_jax.io.policy import MeanPolicy, load_policy
from hgail_jax.io.provenance import provenance
from hgail_jax.seeds import SeedsEvaluation, SeedsStep, trace_evaluation
from hgail_jax.terminal.status import StatusLine
from hgail_jax.trainer.checkpoint import Checkpoint, Checkpoints
from hgail_jax.trainer.folder import create_folder, newest_folder, next_folder, reopen_folder, sole_user
from hgail_jax.trainer.loggers import LOGGERS, Logger
from hgail_jax.trainer.loop import Progress, SavingPolicy, begin, is_stopped, train
from hgail_jax.trainer.options import TrainOptions, plan
from hgail_jax.trainer.results import summarize, write_results
from hgail_jax.trainer.run import Run

_RUNS = Path("runs")


class Trainer:
    """Trains a run and keeps its folder.

        trainer = Trainer(task="reach", seeds=2)
        summary = trainer.train()
        action = trainer.policy(seed=0)(observation)

    Nothing is written before `train`, or `open`, which it calls. A training that was stopped goes on, in this process
    or another, with `resume=trainer.folder`, and ends with the bits of one that was not. Of several processes that
    train together each has a trainer; the first writes the folder.

    Args:
      options: what to train.
      **changes: fields of `TrainOptions` that differ from `options`.

    Raises:
      ValueError: an option has a value that it cannot have.

    """

    def __init__(self, options: TrainOptions | None = None, **changes: Any) -> None:
        self.options = dataclasses.replace(options or TrainOptions(), **changes)
        self._started = time.perf_counter()
        self.run: Run = plan(self.options, platform_name())
        self._held = contextlib.ExitStack()
        self._folder: Path | None = None
        self._checkpoints: Checkpoints | None = None
        self._restored: Checkpoint | None = None
        self._unwanted: Path | None = None
        self._loggers: list[Logger] = []
        self._done = False
        self.in_rounds = False
        """Whether a stop ends with a checkpoint of what was done: while rounds are run."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def folder(self) -> Path:
        """The run's folder."""
        if self._folder is None:
            raise ValueError("the run has no folder yet; train it")
        return self._folder

    @property
    def checkpoints(self) -> Checkpoints:
        """The run's checkpoints."""
        if self._checkpoints is None:
            raise ValueError("the run has no checkpoints yet; train it")
        return self._checkpoints

    @property
    def writes(self) -> bool:
        """Whether this process, of several, is the one that writes the folder."""
        return is_first_process()

    def policy(self, seed: int) -> MeanPolicy:
        """Returns the trained policy of a seed.

        Raises:
          FileNotFoundError: it is not trained yet, or not by this run.

        """
        return load_policy(self.folder / "policies" / f"seed-{seed}.npz")

    def open(self) -> None:
        """Makes the run's folder, or opens the one to go on with; until `close` no other process can.

        Where one of several processes cannot, none of them goes on.

        Raises:
          ValueError: the folder, or its checkpoints, cannot be used.
          OSError: likewise.

        """
        if self._folder is not None:
            raise ValueError(f"{self._folder} is open already")
        self._unwanted = self._held.enter_context(silent_but_first())
        refusal: Exception | None = None
        try:
            self._open()
        except (ValueError, OSError) as error:
            refusal = error
        if any_process(refusal is not None):
            self.close()
            raise refusal or ValueError("another process cannot go on, and says why")

    def close(self) -> None:
        """Lets go of the folder."""
        self._held.close()

    def train(self, stop: threading.Event | None = None) -> dict[str, Any] | None:
        """Trains and evaluates all seeds, and writes everything into the folder, which it closes if it opened it.

        Args:
          stop: once it is set, the training ends with the round that it is in, and a checkpoint.

        Returns:
          The content of summary.json, or None if it was stopped. A run that was finished before is left as it is.

        Raises:
          FloatingPointError: no seed's update was finite in a round, or no episode's simulation; the last checkpoint is
            from before that.
          OverflowError: the simulation ran out of room for contacts; likewise.
          OSError: something cannot be written.
          ValueError: see `open`; or this trainer has trained already.

        """
        if self._done:
            raise ValueError(f"this trainer has trained; a new one goes on with resume={str(self.folder)!r}")
        with contextlib.ExitStack() as closing:
            if self._folder is None:
                closing.callback(self.close)
                self.open()
            self._done = True
            finished = self._finished()
            if any_process(finished is not None):
                return finished
            made_by = provenance()
            settings = self._write_config(made_by)
            summary = self._train(settings, stop or threading.Event())
            if summary is not None:
                before = self._restored.record["seconds"] if self._restored else 0.0  # trained, by other processes
                summary["wall_seconds"]["total"] = before + time.perf_counter() - self._started
                write_json(self.folder / "summary.json", summary | made_by)
                for logger in self._loggers:
                    logger.finish(summary, self.folder / "curves.png")
        return summary

    def log_film(self, path: Path) -> None:
        """Gives a film of a trained policy to the loggers, before `close`."""
        for logger in self._loggers:
            logger.film(path)

    def _open(self) -> None:
        folder, resumed = self._choose_folder()
        checkpoints = Checkpoints(folder / "checkpoints", self.run.identity())
        if resumed:
            reopen_folder(folder, self.run.identity())
        else:
            create_folder(folder)
        self._held.enter_context(sole_user(folder))
        if resumed:
            self._restored = checkpoints.restore(jax.eval_shape(self.run.program().init))
            _announce(folder, self._restored, self.run.config.rounds)
        self._folder, self._checkpoints = folder, checkpoints

    def _choose_folder(self) -> tuple[Path, bool]:
        """Returns the run's folder, and whether it is there already, to be gone on with."""
        options = self.options
        if self._unwanted is not None:
            return self._unwanted, False
        stem = f"{options.task.split(':')[-1]}-{options.method}"
        resumed = newest_folder(_RUNS, stem) if options.resume == "auto" else options.resume
        if resumed is not None:
            return Path(resumed), True
        return Path(options.out) if options.out else next_folder(_RUNS, stem), False

    def _finished(self) -> dict[str, Any] | None:
        """Returns what summary.json, which is written last, already says of this run; None where it is not done."""
        path = self.folder / "summary.json"
        if self._restored is None or self._restored.rounds <= self.run.config.rounds or not path.exists():
            return None
        return cast(dict[str, Any], json.loads(path.read_text()))

    def _write_config(self, made_by: dict[str, Any]) -> dict[str, Any]:
        """Writes config.json, if it is not there, and returns what this process would have in it."""
        remove_partial_files(self.folder)
        path = self.folder / "config.json"
        settings = {"options": dataclasses.asdict(self.options)} | self.run.identity() | made_by
        if not path.exists():
            write_json(path, settings)
        return settings

    def _open_loggers(self, settings: dict[str, Any], history: list[dict[str, Any]]) -> None:
        for name in self.run.loggers if self.writes else ():
            logger = LOGGERS[name](self.folder, self.run, settings, history)
            self._held.callback(logger.close)
            self._loggers.append(logger)

    def _train(self, settings: dict[str, Any], stop: threading.Event) -> dict[str, Any] | None:
        run, program = self.run, self.run.program()
        self._open_loggers(settings, self._restored.record["history"] if self._restored else [])
        timing: dict[str, float] = {}
        # Other threads prepare the physics, make the untrained states and trace the final evaluation while this one
        # compiles the training; the evaluation is compiled while the training runs. They must have done with the device
        # by then: what MuJoCo Warp records in its first steps, to repeat it later, cannot bear another thread's work
        # beside it.
        background = ThreadPoolExecutor(3)
        try:
            with _timed(timing, "compile"), StatusLine("compiling the training program"):
                preparing = background.submit(run.env.prepare)
                initialising = background.submit(program.init)
                tracing = background.submit(self._trace_evaluations)
                step = program.compile()
                preparing.result()
                untrained, traced = initialising.result(), tracing.result()
            progress = begin(program, untrained, self._restored)
            compiling = background.submit(lambda: {name: compile_one() for name, compile_one in traced.items()})
            self._train_rounds(step, progress, stop)
        finally:
            background.shutdown(wait=False)
        if is_stopped(stop):
            with StatusLine("stopped, waiting for the compiler"):  # without which the process cannot end
                wait([compiling])
            return None
        timing["train"] = progress.seconds
        with _timed(timing, "evaluation"), StatusLine("evaluating the policies in the most accurate physics"):
            evaluations = {name: evaluate(progress.states) for name, evaluate in compiling.result().items()}
        states = replicate(progress.states)  # which all processes take part in
        if self.writes:
            write_results(run, self.folder, states, progress.history)
        return summarize(run, progress, evaluations, timing)

    def _trace_evaluations(self) -> dict[str, Callable[[], SeedsEvaluation]]:
        """Returns what compiles the final evaluations.

        They are of the task as it was trained and, if that is randomised, undisturbed too.
        """
        run, states = self.run, jax.eval_shape(self.run.program().init)
        tasks: dict[str, GoalEnv] = {"final": run.env}
        if isinstance(run.env, RandomizedEnv):
            tasks["nominal"] = run.env.nominal()
        return {
            name: trace_evaluation(env, run.config, states, run.evaluation_episodes, run.mesh)
            for name, env in tasks.items()
        }

    def _train_rounds(self, step: SeedsStep, progress: Progress, stop: threading.Event) -> None:
        def log(progress: Progress) -> None:
            for logger in self._loggers:
                logger.rounds(progress.history)

        log(progress)
        saving = SavingPolicy(rounds=self.run.checkpoint_every)
        self.in_rounds = True
        try:
            with self.checkpoints as checkpoints:
                train(self.run.program(), step, progress, checkpoints, saving, stop, after_round=log)
        finally:
            self.in_rounds = False


def _announce(folder: Path, restored: Checkpoint | None, rounds: int) -> None:
    """Says where a run of so many rounds goes on, and what of it is damaged."""
    for line in restored.damaged if restored else ():
        print(line, file=sys.stderr)
    if restored is None:
        print(f"{folder} has no checkpoint yet and begins with round 0")
    elif restored.rounds <= rounds:
        print(f"{folder} goes on after round {restored.rounds - 1} of {rounds}")
    elif (folder / "summary.json").exists():
        print(f"{folder} is complete")
    else:
        print(f"{folder} has all its rounds; its results are written")


@contextlib.contextmanager
def _timed(timing: dict[str, float], name: str) -> Iterator[None]:
    """Notes the seconds that a block takes."""
    started = time.perf_counter()
    yield
    timing[name] = time.perf_counter() - started

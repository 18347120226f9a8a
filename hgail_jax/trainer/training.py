"""One run from its compilation to its results, and the trainer, by which a notebook has one."""

import contextlib
import dataclasses
import json
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, cast

import jax

from hgail_envs import GoalEnv
from hgail_envs.randomized import RandomizedEnv
from hgail_envs.validation import plain_number
from hgail_jax.devices.sharding import any_process, is_first_process, replicate
from hgail_jax.io.files import remove_partial_files, write_json
from hgail_jax.io.policy import AnyPolicy, load_any_policy
from hgail_jax.io.provenance import provenance
from hgail_jax.seeds import SeedsEvaluation, SeedsStep, trace_evaluation
from hgail_jax.settings.defaults import platform_name
from hgail_jax.terminal import StatusLine
from hgail_jax.trainer.camera import TEACHER, kept_teacher
from hgail_jax.trainer.folder import RunFolder, open_run_folder
from hgail_jax.trainer.loggers import LOGGERS
from hgail_jax.trainer.loop import Progress, SavingPolicy, begin, is_stopped, train
from hgail_jax.trainer.results import summarize, write_results
from hgail_jax.trainer.run import Run
from hgail_jax.trainer.train_options import TrainOptions, plan

_MOST_OF_SAVING = 0.05  # of the time of a run with a replay buffer


class Trainer:
    """Trains a run and keeps its folder.

        trainer = Trainer(task="reach", seeds=2)
        summary = trainer.train()
        action = trainer.policy(seed=0)(observation)

    Its arguments are fields of `TrainOptions`, in which it may differ from `options`, and any other field of `Config`,
    its learner or `Hyperparameters`, such as `updates=512` and `tau=0.01`. Nothing is written before
    `train`. A training that was stopped resumes, in this process or another, with `resume=trainer.folder`, and ends
    with the bits of one that was not. Of several processes that train together each has a trainer; the first writes the
    folder.

    Raises:
      ValueError: an option has a value that it cannot have.
    """

    def __init__(self, options: TrainOptions | None = None, **changes: Any) -> None:
        named = {field.name for field in dataclasses.fields(TrainOptions)}
        settings = {name: changes.pop(name) for name in set(changes) - named}
        given = with_settings(dataclasses.replace(options or TrainOptions(), **changes), settings)
        numbers = {field.name: plain_number(getattr(given, field.name)) for field in dataclasses.fields(given)}
        self.options = dataclasses.replace(given, **numbers)
        self.run: Run = plan(self.options, platform_name())
        self._folder: Path | None = None

    @property
    def folder(self) -> Path:
        """The run's folder."""
        if self._folder is None:
            raise ValueError("the run has no folder yet; train it")
        return self._folder

    def policy(self, seed: int) -> AnyPolicy:
        """Returns the trained policy of a seed; a FileNotFoundError says that it is not trained yet."""
        return load_any_policy(self.folder / "policies" / f"seed-{seed}.npz")

    def train(self, stop: threading.Event | None = None) -> dict[str, Any] | None:
        """Trains and evaluates all seeds, and writes everything into the folder; see `open_run_folder`, `train_run`."""
        with open_run_folder(self.run, self.options.out, self.options.resume) as folder:
            self._folder = folder.path
            return train_run(self.run, folder, stop)


def with_settings(options: TrainOptions, settings: Mapping[str, Any]) -> TrainOptions:
    """Returns options with further `settings`, Python values by the names of their fields."""
    given = {name: plain_number(value) for name, value in settings.items()}
    try:
        written = tuple(f"{name}={json.dumps(value)}" for name, value in sorted(given.items()))
    except TypeError as error:
        raise ValueError(f"settings {given} are not numbers, True, False or lists of numbers") from error
    return dataclasses.replace(options, settings=(*options.settings, *written))


def train_run(run: Run, folder: RunFolder, stop: threading.Event | None = None) -> dict[str, Any] | None:
    """Trains and evaluates all seeds of a run, and writes everything into its folder, from `open_run_folder`.

    Once `stop` is set, the training ends with the round that it is in, and a checkpoint. Returns the content of
    summary.json, or None if it was stopped; a run that was finished before is left as it is. See
    `hgail_jax.trainer.loop.train` for errors; a file that cannot be written is an OSError.
    """
    finished = _finished(run, folder)
    if any_process(finished is not None):
        return finished
    made_by = provenance()
    settings = {"options": run.options} | run.identity() | made_by
    remove_partial_files(folder.path)
    if not (folder.path / "config.json").exists():
        write_json(folder.path / "config.json", settings)
    if run.teacher is not None and kept_teacher(folder.path) is None:
        shutil.copyfile(run.teacher, folder.path / TEACHER)
    history = folder.restored.history if folder.restored else []
    for name in run.loggers if is_first_process() else ():
        folder.loggers.append(LOGGERS[name](folder.path, run, settings, history))
    summary = _train(run, folder, stop or threading.Event())
    if summary is not None:
        before = folder.restored.record["seconds"] if folder.restored else 0.0  # in the rounds of other processes
        summary["wall_seconds"]["total"] = before + time.perf_counter() - run.started
        write_json(folder.path / "summary.json", summary | made_by)
        for logger in folder.loggers:
            logger.finish(summary, folder.path / "curves.png")
    return summary


def _finished(run: Run, folder: RunFolder) -> dict[str, Any] | None:
    """Returns the content of summary.json, which is written last; None before that."""
    path = folder.path / "summary.json"
    if folder.restored is None or folder.restored.rounds <= run.config.rounds or not path.exists():
        return None
    return cast(dict[str, Any], json.loads(path.read_text()))


def _train(run: Run, folder: RunFolder, stop: threading.Event) -> dict[str, Any] | None:
    timing = dict[str, float]()
    # Other threads prepare the physics, make the untrained states and trace the final evaluation while this one
    # compiles the training; the evaluation is compiled while the training runs. They must have done with the device
    # by then: the graph that MuJoCo Warp records in its first steps, to repeat it later, cannot bear another thread's
    # work beside it.
    background = ThreadPoolExecutor(3)
    try:
        with _timed(timing, "compile"), StatusLine("compiling the training program"):
            preparing = background.submit(run.env.prepare)
            initialising = background.submit(run.init)
            tracing = background.submit(trace_evaluations, run)
            step = run.compile()
            preparing.result()
            untrained, traced = initialising.result(), tracing.result()
        progress = begin(run, untrained, folder.restored)
        compiling = background.submit(lambda: {name: compile_one() for name, compile_one in traced.items()})
        train_rounds(run, folder, step, progress, stop)
    finally:
        background.shutdown(wait=False)
    if is_stopped(stop):
        with StatusLine("stopped, waiting for the compiler"):  # without which the process cannot end
            wait([compiling])
        return None
    timing["train"] = progress.seconds
    with _timed(timing, "evaluation"), StatusLine("evaluating the policies"):
        evaluations = {name: evaluate(progress.states) for name, evaluate in compiling.result().items()}
    states = replicate(progress.states)  # all processes take part in this
    if is_first_process():
        write_results(run, folder.path, states, progress.history)
    return summarize(run, progress, evaluations, timing)


def trace_evaluations(run: Run) -> dict[str, Callable[[], SeedsEvaluation]]:
    """Traces the final evaluations, of a randomised task the nominal one too; returns functions that compile them."""
    states = jax.eval_shape(run.init)
    tasks: dict[str, GoalEnv] = {"final": run.env}
    if isinstance(run.env, RandomizedEnv) and run.env.randomization != run.env.randomization.nominal():
        tasks["nominal"] = run.env.nominal()
    return {
        name: trace_evaluation(env, run.config, states, run.evaluation_episodes, run.mesh)
        for name, env in tasks.items()
    }


def train_rounds(run: Run, folder: RunFolder, step: SeedsStep, progress: Progress, stop: threading.Event) -> None:
    """Runs the rounds that are left, with loggers and checkpoints."""

    def log(progress: Progress) -> None:
        for logger in folder.loggers:
            logger.rounds(progress.history)

    log(progress)
    # a replay buffer of hundreds of megabytes takes a second to copy
    saving = SavingPolicy(run.checkpoint_every, most=1.0 if progress.states.buffer is None else _MOST_OF_SAVING)
    folder.in_rounds.set()
    try:
        with folder.checkpoints as checkpoints:
            kept = checkpoints if run.config.learner.resumes else None
            train(run, step, progress, kept, saving, stop, after_round=log)
    finally:
        folder.in_rounds.clear()


@contextlib.contextmanager
def _timed(timing: dict[str, float], name: str) -> Iterator[None]:
    started = time.perf_counter()
    yield
    timing[name] = time.perf_counter() - started

"""A run's folder, held open by the one process that trains in it."""

import contextlib
import dataclasses
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import jax

from hgail_jax.devices.processes import silent_but_first
from hgail_jax.devices.sharding import any_process
from hgail_jax.trainer.checkpoint import Checkpoint, Checkpoints
from hgail_jax.trainer.folder import create_folder, newest_folder, next_folder, reopen_folder, sole_user
from hgail_jax.trainer.loggers import Logger
from hgail_jax.trainer.run import Run

_RUNS = Path("runs")


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """A run's open folder; until it is closed no other process can train in it."""

    path: Path
    checkpoints: Checkpoints
    restored: Checkpoint | None
    """Checkpoint that the run goes on from; None begins it."""
    loggers: list[Logger] = dataclasses.field(default_factory=list)
    """Opened by the training, closed with the folder."""
    in_rounds: threading.Event = dataclasses.field(default_factory=threading.Event)
    """Set while rounds run: a stop then ends with a checkpoint of them."""


@contextlib.contextmanager
def open_run_folder(run: Run, out: Path | str | None, resume: Path | str | None) -> Iterator[RunFolder]:
    """Makes the folder of a run, or opens the one to go on with. If one of several processes cannot, none goes on.

    Args:
      run: the run to train.
      out: folder to make; None numbers one in `runs/`.
      resume: folder of a run that goes on; `"auto"` takes the newest in `runs/`, if there is one.

    Raises:
      ValueError: the folder, or its checkpoints, cannot be used.
      OSError: likewise.

    """
    with contextlib.ExitStack() as held:
        unwanted = held.enter_context(silent_but_first())
        refusal: Exception | None = None
        try:
            path, goes_on = (unwanted, False) if unwanted is not None else _choose(run, out, resume)
            folder = _open(run, path, goes_on, held)
        except (ValueError, OSError) as error:
            refusal = error
        if any_process(refusal is not None):
            raise refusal or ValueError("another process cannot go on, and says why")
        yield folder


def _choose(run: Run, out: Path | str | None, resume: Path | str | None) -> tuple[Path, bool]:
    """Returns the run's folder, and whether it is there already, to be gone on with."""
    stem = f"{run.task.split(':')[-1]}-{run.method}"
    resumed = newest_folder(_RUNS, stem) if resume == "auto" else resume
    if resumed is not None:
        return Path(resumed), True
    return Path(out) if out else next_folder(_RUNS, stem), False


def _open(run: Run, path: Path, goes_on: bool, held: contextlib.ExitStack) -> RunFolder:
    checkpoints = Checkpoints(path / "checkpoints", run.identity())
    restored = None
    if goes_on:
        reopen_folder(path, run.identity())
    else:
        create_folder(path)
    held.enter_context(sole_user(path))
    if goes_on:
        restored = checkpoints.restore(jax.eval_shape(run.program().init))
        _announce(path, restored, run.config.rounds)
    folder = RunFolder(path, checkpoints, restored)
    held.callback(_close, folder.loggers)
    return folder


def _close(loggers: list[Logger]) -> None:
    for logger in loggers:
        logger.close()


def _announce(path: Path, restored: Checkpoint | None, rounds: int) -> None:
    """Prints the round that a run of so many rounds goes on with, and its damaged checkpoints."""
    for line in restored.damaged if restored else ():
        print(line, file=sys.stderr)
    if restored is None:
        print(f"{path} has no checkpoint yet and begins with round 0")
    elif restored.rounds <= rounds:
        print(f"{path} goes on after round {restored.rounds - 1} of {rounds}")
    elif (path / "summary.json").exists():
        print(f"{path} is complete")
    else:
        print(f"{path} has all its rounds; its results are written")

"""The folder of a run: its name, the guard that keeps other runs and processes out of it, and its checkpoints.

A folder that cannot be used is a ValueError, whose message says why and what to do instead.
"""

import contextlib
import dataclasses
import itertools
import json
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import filelock
import jax

from hgail_jax.devices.processes import silent_but_first
from hgail_jax.devices.sharding import any_process
from hgail_jax.terminal import say
from hgail_jax.trainer.checkpoint import Checkpoint, Checkpoints, refuse_another_run
from hgail_jax.trainer.loggers import Logger
from hgail_jax.trainer.run import Run

_RUNS = Path("runs")
_NAME_ANOTHER = "name another folder, or none to have one numbered"


def create_numbered_folder(parent: Path, stem: str) -> Path:
    """Makes and returns `parent/stem-N` for the smallest N from 1 that is larger than any there already."""
    for number in itertools.count(_next_number(parent, stem)):
        path = parent / f"{stem}-{number}"
        try:
            return create_folder(path)
        except ValueError:
            if not path.exists():  # else a run that began at the same moment has this number
                raise
    raise AssertionError("numbers do not end")


def _next_number(parent: Path, stem: str) -> int:
    return 1 + max(_numbers(parent, stem), default=0)


def newest_folder(parent: Path, stem: str) -> Path | None:
    """Returns the `parent/stem-N` of the run that was saved, or begun, last; None if there is no run."""
    folders = [parent / f"{stem}-{number}" for number in sorted(_numbers(parent, stem), reverse=True)]
    return max(filter(_last_saved, folders), key=_last_saved, default=None)


def _numbers(parent: Path, stem: str) -> list[int]:
    names = [path.name for path in parent.iterdir()] if parent.is_dir() else []
    endings = [name.removeprefix(f"{stem}-") for name in names if name.startswith(f"{stem}-")]
    return [int(ending) for ending in endings if ending.isdecimal()]


def _last_saved(folder: Path) -> int:
    """Returns the time of a run's last checkpoint, else of its start, in nanoseconds; 0 if it is no run's folder."""
    config, checkpoints = folder / "config.json", folder / "checkpoints"
    if config.exists():
        return (checkpoints if checkpoints.exists() else config).stat().st_mtime_ns
    return folder.stat().st_mtime_ns if folder.is_dir() and _is_empty(folder) else 0


def _is_empty(folder: Path) -> bool:
    """Returns whether a run can begin in an existing folder: it is empty but for a killed process's partial files."""
    return all(path.name.startswith(".") for path in folder.iterdir())


def create_folder(path: Path) -> Path:
    """Makes a run's folder, which must not be there already, and returns it."""
    try:
        path.mkdir(parents=True)
        return path
    except FileExistsError:
        raise _taken(path) from None
    except OSError as error:
        raise ValueError(f"cannot make the folder {path}: {error.strerror}") from None


def _taken(path: Path) -> ValueError:
    unfinished = (path / "config.json").exists() and not (path / "summary.json").exists()
    hint = f"resume its run by --resume {path}, or name another folder" if unfinished else _NAME_ANOTHER
    return ValueError(f"{path} exists already; {hint}")


def resumed_folder(task: str, method: str, resume: Path | str | None) -> Path | None:
    """Returns the folder that `resume` names, `"auto"` the newest of the task and method; None begins a run."""
    if resume == "auto":
        return newest_folder(_RUNS, _stem(task, method))
    return Path(resume).expanduser() if resume else None


def student_folder(task: str, method: str, out: Path | str | None, resume: Path | str | None) -> Path:
    """Returns the folder that a run without a teacher as yet will have, not made; a ValueError if it cannot have it."""
    path = resumed_folder(task, method, resume)
    if path is not None:
        if not path.is_dir():
            raise _missing(path)
        if not _is_empty(path):
            raise ValueError(f"{path} holds a run without a teacher, which cannot be resumed as a student's")
        return path
    if not out:
        stem = _stem(task, method)
        return _RUNS / f"{stem}-{_next_number(_RUNS, stem)}"
    path = Path(out).expanduser()
    if path.exists():
        raise _taken(path)
    return path


def _missing(path: Path) -> ValueError:
    return ValueError(f"there is no folder {path} to resume")


def _stem(task: str, method: str) -> str:
    return f"{task.split(':')[-1]}-{method}"


def reopen_folder(path: Path, identity: dict) -> None:
    """Checks that a folder is empty, or that of the run with this identity; writes nothing."""
    if not path.is_dir():
        raise _missing(path)
    if _is_empty(path):
        return
    try:
        content = json.loads((path / "config.json").read_text())
        there = {name: content[name] for name in identity}
    except FileNotFoundError:
        raise ValueError(f"{path} is not the folder of a run that can be resumed: it has no config.json") from None
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is not the folder of a run that can be resumed: {error}") from None
    refuse_another_run(path, there, identity)


@contextlib.contextmanager
def sole_user(path: Path) -> Iterator[None]:
    """Holds a folder for this process, by its file `.lock`; the system lets go of it however the process ends."""
    lock = filelock.FileLock(path / ".lock", timeout=0)
    try:
        lock.acquire()
    except filelock.Timeout:
        raise ValueError(f"{path} is in use by another process") from None
    try:
        yield
    finally:
        lock.release()


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """A run's open folder; until it is closed no other process can train in it."""

    path: Path
    checkpoints: Checkpoints
    restored: Checkpoint | None
    """Checkpoint that the run resumes from; None begins it."""
    loggers: list[Logger] = dataclasses.field(default_factory=list)
    """Opened by the training, closed with the folder."""
    in_rounds: threading.Event = dataclasses.field(default_factory=threading.Event)
    """Set while rounds run: a stop then ends with a checkpoint of them."""


@contextlib.contextmanager
def open_run_folder(run: Run, out: Path | str | None, resume: Path | str | None) -> Iterator[RunFolder]:
    """Makes the folder of a run, or opens the one to resume. If one of several processes cannot, none continues.

    It makes `out`, or where that is None numbers a folder in `runs/`; to `resume` `"auto"` takes the newest there, if
    there is one. A folder that cannot be written to is an OSError.
    """
    with contextlib.ExitStack() as held:
        unwanted = held.enter_context(silent_but_first())
        refusal: Exception | None = None
        try:
            if unwanted is not None:  # of a process that writes no files
                out, resume = unwanted, None
            folder = _open(run, out, resume, held)
        except (ValueError, OSError) as error:
            refusal = error
        if any_process(refusal is not None):
            raise refusal or ValueError("another process failed; see its message")
        yield folder


def _open(run: Run, out: Path | str | None, resume: Path | str | None, held: contextlib.ExitStack) -> RunFolder:
    path = resumed_folder(run.task, run.method, resume)
    if path is None:
        stem = _stem(run.task, run.method)
        path = create_folder(Path(out).expanduser()) if out else create_numbered_folder(_RUNS, stem)
        held.enter_context(sole_user(path))
        folder = RunFolder(path, Checkpoints(path / "checkpoints", run.identity()), None)
    else:
        checkpoints = Checkpoints(path / "checkpoints", run.identity())
        reopen_folder(path, run.identity())
        held.enter_context(sole_user(path))
        folder = RunFolder(path, checkpoints, checkpoints.restore(jax.eval_shape(run.init)))
        _announce(folder, run.config.rounds)
    held.callback(_close, folder.loggers)
    return folder


def _close(loggers: list[Logger]) -> None:
    for logger in loggers:
        logger.close()


def _announce(folder: RunFolder, rounds: int) -> None:
    """Prints the round that a run of so many rounds resumes with, and its damaged checkpoints."""
    path, restored = folder.path, folder.restored
    for line in restored.damaged if restored else ():
        say(line, sys.stderr)
    if restored is None:
        say(f"{path} has no checkpoint yet and begins with round 0")
    elif restored.rounds <= rounds:
        say(f"{path} resumes after round {restored.rounds - 1} of {rounds}")
    elif (path / "summary.json").exists():
        say(f"{path} is complete; without --resume another run begins")
    else:
        say(f"{path} has all its rounds; its results are written")

"""The folder of a run: its name, and the guard that keeps other runs and other processes out of it."""

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_NAME_ANOTHER = "name another folder, or none to have one numbered"


def next_folder(parent: Path, stem: str) -> Path:
    """Returns `parent/stem-N` for the smallest N from 1 that is larger than any there already."""
    return parent / f"{stem}-{1 + max(_numbers(parent, stem), default=0)}"


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


def create_folder(path: Path) -> None:
    """Makes a run's folder.

    Raises:
      ValueError: it is there already, or cannot be made.

    """
    try:
        path.mkdir(parents=True)
    except FileExistsError:
        unfinished = (path / "config.json").exists() and not (path / "summary.json").exists()
        hint = f"go on with its run by --resume {path}, or name another folder" if unfinished else _NAME_ANOTHER
        raise ValueError(f"{path} exists already; {hint}") from None
    except OSError as error:
        raise ValueError(f"cannot make the folder {path}: {error.strerror}") from None


def reopen_folder(path: Path, identity: dict) -> None:
    """Checks that a folder is empty, or that of the run with this identity; writes nothing.

    Raises:
      ValueError: it is neither.

    """
    if not path.is_dir():
        raise ValueError(f"there is no folder {path} to resume")
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
    """Holds a folder for this process; the system lets go of it however the process ends.

    Raises:
      ValueError: another process holds it.

    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(f"{path} is in use by another process") from None
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(descriptor)


class AnotherRunError(ValueError):
    """A folder or checkpoint belongs to another run; the message names the first difference."""


def refuse_another_run(folder: Path | str, there: dict, here: dict) -> None:
    """Raises an AnotherRunError that names the first entry in which two nested dicts, of JSON's types, differ."""
    difference = _difference(there, as_json(here))
    if difference is not None:
        name, of_there, of_here = difference
        raise AnotherRunError(f"{folder} holds another run: {name} is {of_there} there and {of_here} here")


def _difference(there: Any, here: Any, name: str = "") -> tuple[str, Any, Any] | None:
    if not (isinstance(there, dict) and isinstance(here, dict)):
        return None if there == here else (name, there, here)
    for key in [*here, *(key for key in there if key not in here)]:
        found = _difference(there.get(key, "absent"), here.get(key, "absent"), f"{name}.{key}" if name else key)
        if found is not None:
            return found
    return None


def as_json(content: Any) -> Any:
    """Returns `content` as JSON gives it back: tuples are lists, keys are text."""
    return json.loads(json.dumps(content))

"""Writes files under a name that they get once they are whole, and reads npz archives that need not be trusted."""

import contextlib
import csv
import errno
import io
import json
import os
import re
import shutil
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, TypeVar

import jax
import numpy as np

_PARTIAL = ".partial"
_NUMBERS = re.compile(r'\[\n([^][{}"]*)\]')


@contextlib.contextmanager
def replace_file(path: Path | str, mode: str = "w") -> Iterator[IO]:
    """Opens a temporary file beside `path` that takes its name once it is whole, and is removed if writing fails."""
    with replace_path(path) as temporary, temporary.open(mode) as file:
        yield file


@contextlib.contextmanager
def replace_path(path: Path | str) -> Iterator[Path]:
    """Yields the name of a temporary file or folder, for a writer that makes it itself; see `replace_file`."""
    path = Path(path)
    temporary = path.with_name(f".{os.getpid()}{_PARTIAL}.{path.name}")
    try:
        yield temporary
        temporary.replace(path)
    except BaseException:
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)
        raise


def check_writable(path: Path) -> None:
    """Refuses, with an OSError, a file that could not be written later, with the folders that are missing."""
    nearest = next(folder for folder in path.absolute().parents if folder.exists())
    for place, refused, number in (
        (path, path.is_dir(), errno.EISDIR),
        (nearest, not nearest.is_dir(), errno.ENOTDIR),
        (nearest, not os.access(nearest, os.W_OK | os.X_OK), errno.EACCES),
    ):
        if refused:
            raise OSError(number, os.strerror(number), str(place))


def check_new_file(path: Path, endings: Collection[str] = ()) -> None:
    """Refuses a file that is there, or ends in none of `endings`, if any: a ValueError. See also `check_writable`."""
    if endings and path.suffix.lower() not in endings:
        raise ValueError(f"{path} has an unknown format; it must end in {', '.join(endings)}")
    if os.path.lexists(path):
        raise ValueError(f"{path} exists already; name another file, or remove it")
    check_writable(path)


def from_here(path: Path) -> Path:
    """Returns a path as seen from the working directory, if it lies in there; else the path itself."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def remove_partial_files(folder: Path) -> None:
    """Removes from a folder the temporary files of a process that was killed."""
    for path in folder.glob(f".*{_PARTIAL}.*"):
        path.unlink(missing_ok=True)


def write_json(path: Path, content: dict) -> None:
    """Writes a JSON file, a list of numbers on one line; NaN and infinities become null, NumPy's numbers numbers."""
    text = json.dumps(_plain(content), indent=2)
    with replace_file(path) as file:
        file.write(_NUMBERS.sub(lambda numbers: f"[{' '.join(numbers[1].split())}]", text) + "\n")


def write_csv(path: Path, rows: list[dict]) -> None:
    """Writes rows that all have the columns of the first; None is left empty."""
    with replace_file(path) as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [])
        if rows:
            writer.writeheader()
        writer.writerows(rows)


def append_csv(path: Path, rows: list[dict]) -> None:
    """Adds rows to those of `write_csv`, in the same columns; a failure leaves the file as it was."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows(row.values() for row in rows)
    size = path.stat().st_size
    try:
        with path.open("a", newline="") as file:
            file.write(text.getvalue())
    except OSError:
        os.truncate(path, size)
        raise


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return _plain(value.tolist())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


ContentT = TypeVar("ContentT")


def save_npz(path: Path | str, header: dict, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes arrays as an npz archive that is not compressed, with a header in JSON, of which `format` is an entry."""
    with replace_file(path, "wb") as file:
        np.savez(file, **arrays, header=np.array(json.dumps(header)))  # type: ignore[arg-type]


def load_npz(
    path: Path | str, kind: str, formats: Mapping[str, Callable[[dict, Mapping[str, np.ndarray]], ContentT]]
) -> ContentT:
    """Opens an archive of `save_npz` and returns its content.

    The function of its format, in `formats`, makes it of the header and the arrays by name. Any error that it raises
    says that the file does not hold this `kind` of content, e.g. `"a policy"`. Nothing in the archive is unpickled. It
    must not be compressed, so that a small file cannot unfold into one that fills the memory.

    Raises:
      FileNotFoundError: there is no such file.
      ValueError: it does not hold this content.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    if not path.is_file():  # opening a pipe would wait for a writer
        raise ValueError(f"{path} does not hold {kind}: it is no regular file")
    try:
        with zipfile.ZipFile(path) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise ValueError("it is compressed")
        with np.load(path, allow_pickle=False) as arrays:
            header = json.loads(str(arrays["header"]))
            if header["format"] not in formats:
                raise ValueError(f"its format is {header['format']!r}, not {' or '.join(map(repr, formats))}")
            return formats[header["format"]](header, arrays)
    except Exception as error:  # zipfile, numpy, json and the function raise errors of many types
        raise ValueError(f"{path} does not hold {kind}: {error}") from error

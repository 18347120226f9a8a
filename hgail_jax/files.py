"""Writes files so that a name never stands for half a file."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO

_PARTIAL = ".partial"


@contextlib.contextmanager
def replace_file(path: Path | str, mode: str = "w") -> Iterator[IO]:
    """Opens a temporary file beside `path` that takes its name once it is whole, and is removed if writing fails."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}{_PARTIAL}")
    try:
        with temporary.open(mode) as file:
            yield file
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def remove_partial_files(folder: Path) -> None:
    """Removes from a folder the temporary files of a process that was killed."""
    for path in folder.glob(f".*{_PARTIAL}"):
        path.unlink(missing_ok=True)

"""Reads npz archives of arrays that need not be trusted."""

import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np

ContentT = TypeVar("ContentT")

_LARGEST_FILE = 2**30  # bytes


def load_npz(path: Path | str, what: str, read: Callable[[Mapping[str, np.ndarray]], ContentT]) -> ContentT:
    """Opens an npz archive and returns what `read` makes of its arrays.

    Nothing in the archive is unpickled. It must not be compressed, so that a small file cannot unfold into one that
    fills the memory.

    Args:
      path: the file.
      what: what it should hold, for the error, e.g. `"a policy"`.
      read: takes the arrays by name; whatever it raises says that the file does not hold `what`.

    Raises:
      FileNotFoundError: there is no such file.
      ValueError: it does not hold `what`.

    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    if not path.is_file():  # to open a pipe would wait for somebody to write to it
        raise ValueError(f"{path} does not hold {what}: it is no regular file")
    try:
        with zipfile.ZipFile(path) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise ValueError("it is compressed")
            if sum(member.file_size for member in archive.infolist()) > _LARGEST_FILE:
                raise ValueError(f"it is larger than {_LARGEST_FILE} bytes")
        with np.load(path, allow_pickle=False) as arrays:
            return read(arrays)
    except FileNotFoundError:
        raise
    except Exception as error:  # zipfile, numpy, json and `read` raise what they like
        raise ValueError(f"{path} does not hold {what}: {error}") from error

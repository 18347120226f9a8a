"""Reads npz archives of arrays that need not be trusted."""

import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np

ContentT = TypeVar("ContentT")

_LARGEST_FILE = 2**30  # bytes, far above any policy or set of demonstrations


def load_npz(path: Path | str, kind: str, read: Callable[[Mapping[str, np.ndarray]], ContentT]) -> ContentT:
    """Opens an npz archive and returns its content, as `read` makes it of the arrays.

    Nothing in the archive is unpickled. It must not be compressed, so that a small file cannot unfold into one that
    fills the memory.

    Args:
      path: the file.
      kind: of its content, for the error, e.g. `"a policy"`.
      read: takes the arrays by name; any error that it raises says that the file does not hold this content.

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
        if not zipfile.is_zipfile(path):
            raise ValueError("it is no npz archive")
        with zipfile.ZipFile(path) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise ValueError("it is compressed")
            if sum(member.file_size for member in archive.infolist()) > _LARGEST_FILE:
                raise ValueError(f"it is larger than {_LARGEST_FILE} bytes")
        with np.load(path, allow_pickle=False) as arrays:
            return read(arrays)
    except FileNotFoundError:
        raise
    except Exception as error:  # zipfile, numpy, json and `read` raise errors of many types
        raise ValueError(f"{path} does not hold {kind}: {error}") from error

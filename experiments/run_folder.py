"""The folder that a run writes: what stands in it, and that nothing in it is ever overwritten."""

import csv
import importlib.metadata
import json
import platform
import shlex
import sys
from pathlib import Path

import jax
import numpy as np

from hgail_jax.files import replace_file

_PACKAGES = ("hgail-jax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "numpy")


def next_folder(parent: Path, stem: str) -> Path:
    """Returns `parent/stem-N` for the smallest N from 1 that is larger than any there already."""
    taken = [path.name.removeprefix(f"{stem}-") for path in parent.glob(f"{stem}-*")]
    return parent / f"{stem}-{1 + max((int(number) for number in taken if number.isdecimal()), default=0)}"


def create_folder(path: Path) -> None:
    """Makes a run's folder.

    Raises:
      ValueError: it is there already, or cannot be made.

    """
    try:
        path.mkdir(parents=True)
    except FileExistsError:
        raise ValueError(f"{path} exists already; name another folder, or none to have one numbered") from None
    except OSError as error:
        raise ValueError(f"cannot make the folder {path}: {error.strerror}") from None


def provenance() -> dict:
    """Returns what made a result: command, device and versions."""
    device = jax.devices()[0]
    name = platform.processor() or platform.machine() if device.platform == "cpu" else device.device_kind
    return {
        "command": shlex.join(["python", *sys.argv]),
        "device": {"platform": device.platform, "kind": name, "count": jax.device_count()},
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in _PACKAGES},
        "matmul_precision": getattr(jax.config, "jax_default_matmul_precision") or "default",  # noqa: B009  (untyped),
    }


def write_json(path: Path, content: dict) -> None:
    """Writes a JSON file; what is not a number becomes null."""
    with replace_file(path) as file:
        json.dump(_plain(content), file, indent=2)
        file.write("\n")


class MetricsFile:
    """metrics.csv: a row per seed and round, written as the rounds end."""

    def __init__(self, path: Path):
        self._path = path
        self._columns: list[str] = []

    def append(self, rows: list[dict]) -> None:
        """Adds rows, all with the columns of the first."""
        with self._path.open("a", newline="") as file:
            writer = csv.DictWriter(file, self._columns or list(rows[0]))
            if not self._columns:
                self._columns = list(rows[0])
                writer.writeheader()
            writer.writerows({key: "" if value != value else value for key, value in row.items()} for row in rows)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _plain(value):
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | jax.Array):
        return _plain(value.tolist())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value

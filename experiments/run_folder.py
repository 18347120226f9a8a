"""The folder of a run: where it is, and the tables and records in it."""

import contextlib
import csv
import fcntl
import functools
import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

from hgail_jax.checkpoint import refuse_another_run
from hgail_jax.files import replace_file
from hgail_jax.versions import installed

_PACKAGES = (
    "hgail-jax",
    "jax",
    "jaxlib",
    "mujoco",
    "mujoco-mjx",
    "brax",
    "flax",
    "optax",
    "orbax-checkpoint",
    "numpy",
    "warp-lang",
)


def next_folder(parent: Path, stem: str) -> Path:
    """Returns `parent/stem-N` for the smallest N from 1 that is larger than any there already."""
    return parent / f"{stem}-{1 + max(_numbers(parent, stem), default=0)}"


def newest_folder(parent: Path, stem: str) -> Path | None:
    """Returns `parent/stem-N` for the largest N there is, or None."""
    numbers = _numbers(parent, stem)
    return parent / f"{stem}-{max(numbers)}" if numbers else None


def _numbers(parent: Path, stem: str) -> list[int]:
    endings = [path.name.removeprefix(f"{stem}-") for path in parent.glob(f"{stem}-*")]
    return [int(ending) for ending in endings if ending.isdecimal()]


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


def reopen_folder(path: Path, identity: dict) -> None:
    """Checks that a folder is that of the run which has this identity, or empty; writes nothing.

    Raises:
      ValueError: it is neither.

    """
    if not path.is_dir():
        raise ValueError(f"there is no folder {path} to resume")
    if not any(entry for entry in path.iterdir() if not entry.name.startswith(".")):
        return
    try:
        content = json.loads((path / "config.json").read_text())
        there = {name: content[name] for name in identity}
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


def own_command() -> str:
    """Returns the command that started this process."""
    return shlex.join(["python", *sys.argv])


@functools.cache
def _commit() -> str | None:
    """Returns the commit of this checkout, "-dirty" behind it where files differ; None where there is none."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=7", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def provenance() -> dict:
    """Returns what made a result: command, commit, device and versions."""
    device = jax.devices()[0]
    name = platform.processor() or platform.machine() if device.platform == "cpu" else device.device_kind
    return {
        "command": own_command(),
        "commit": _commit(),
        "device": {"platform": device.platform, "kind": name, "count": jax.device_count()},
        "versions": {"python": platform.python_version()} | installed(*_PACKAGES),
        "matmul_precision": getattr(jax.config, "jax_default_matmul_precision") or "default",  # noqa: B009  (untyped),
    }


def write_json(path: Path, content: dict) -> None:
    """Writes a JSON file; what is not a number becomes null."""
    with replace_file(path) as file:
        json.dump(_plain(content), file, indent=2)
        file.write("\n")


def write_metrics(path: Path, rows: list[dict]) -> None:
    """Writes metrics.csv: a row per seed and round, all with the columns of the first; None is left empty."""
    with replace_file(path) as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [])
        if rows:
            writer.writeheader()
        writer.writerows(rows)


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

"""Provenance of a result: command, commit, device, processor cores and versions."""

import functools
import importlib.metadata
import platform
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import jax

from hgail_envs.engines.c import usable_cores
from hgail_jax._version import __version__

_PACKAGES = ["hgail-jax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "numpy", "warp-lang"]
_ROOT = Path(__file__).parents[2]  # of a checkout


def own_command(words: Sequence[str] = sys.orig_argv) -> str:
    """Returns the command that started this process, as one would type it, without the paths of this machine.

    >>> own_command(["/usr/bin/python3", "-m", "experiments.paper", "--all"])
    'python -m experiments.paper --all'
    >>> own_command(["/venv/bin/python", "/venv/bin/hgail", "train", "--seeds", "2"])
    'hgail train --seeds 2'
    """
    _, *rest = words
    if rest and Path(rest[0]).name == "hgail":
        return shlex.join(["hgail", *rest[1:]])
    if rest and Path(rest[0]).is_absolute():
        script = Path(rest[0])
        rest[0] = str(script.relative_to(Path.cwd()) if script.is_relative_to(Path.cwd()) else script.name)
    return shlex.join(["python", *rest])


@functools.cache
def _commit() -> str | None:
    """Returns the commit of this project's own checkout, with "-dirty" if files differ; None elsewhere, or without git.

    A repository around an installed package, or one that has a copy of it, is another project's.
    """
    module = "hgail_jax/io/provenance.py"
    try:
        if _git("ls-files", "--full-name", "--", module) != module:
            return None
        if 'name = "hgail-jax"' not in (_ROOT / "pyproject.toml").read_text():
            return None
        return _git("describe", "--always", "--dirty", "--abbrev=7", "--exclude=*")
    except (OSError, subprocess.CalledProcessError):
        return None


def _git(*words: str) -> str:
    return subprocess.run(["git", "-C", str(_ROOT), *words], capture_output=True, text=True, check=True).stdout.strip()


def provenance(*packages: str) -> dict:
    """Returns command, commit, device, usable processor cores and versions of this process.

    The versions are those of our and further `packages`, and of the GPU's driver, None on a CPU.
    """
    device = jax.devices()[0]
    name = platform.processor() or platform.machine() if device.platform == "cpu" else device.device_kind
    driver = driver_version() if device.platform == "gpu" else None
    return {
        "command": own_command(),
        "commit": _commit(),
        "device": {"platform": device.platform, "kind": name, "count": jax.device_count()},
        "cpu_cores": usable_cores(),
        "versions": {"python": platform.python_version()} | installed(*_PACKAGES, *packages) | {"driver": driver},
        "matmul_precision": getattr(jax.config, "jax_default_matmul_precision") or "default",  # noqa: B009  (untyped),
    }


def installed(*packages: str) -> dict[str, str | None]:
    """Returns the version of each distribution, None if it is not installed; this one may be a bare checkout."""
    return {package: _version(package) for package in packages}


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return __version__ if package == "hgail-jax" else None


def driver_version() -> str | None:
    """Returns the version of the GPUs' driver; None without one."""
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    return next((line.strip() for line in answer.splitlines()), None)

"""What made a result: command, commit, device and versions."""

import functools
import platform
import shlex
import subprocess
import sys
from pathlib import Path

import jax

from hgail_jax.io.versions import installed

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

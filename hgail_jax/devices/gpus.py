"""The GPUs of this machine, without starting JAX on them."""

import os
import subprocess


def visible_gpus() -> list[str]:
    """Returns the GPUs that a program may use, as CUDA_VISIBLE_DEVICES names them; none without a driver."""
    chosen = os.environ.get("CUDA_VISIBLE_DEVICES")
    return [name for name in chosen.split(",") if name] if chosen is not None else _ask("index")


def driver_version() -> str | None:
    """Returns the version of the GPUs' driver; None without one."""
    return next(iter(_ask("driver_version")), None)


def _ask(query: str) -> list[str]:
    command = ["nvidia-smi", f"--query-gpu={query}", "--format=csv,noheader"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return []
    return [line.strip() for line in answer.splitlines()]

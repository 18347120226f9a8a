"""The GPUs of this machine, without starting JAX on them."""

import subprocess


def driver_version() -> str | None:
    """Returns the version of the GPUs' driver; None without one."""
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    return next((line.strip() for line in answer.splitlines()), None)

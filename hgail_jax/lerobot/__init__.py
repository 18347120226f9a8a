"""The bridge to LeRobot, which finds it by `--env.discover_packages_path=hgail_jax.lerobot`; see `docs/lerobot.md`.

LeRobot, and with it PyTorch, is no dependency of this package: only the modules in here import it.
"""

import importlib.util
from pathlib import Path

from hgail_envs import GoalEnv
from hgail_jax.io.demonstrations import Demonstrations, load_demonstrations


def check_installed() -> None:
    """Raises a ValueError that says how to install LeRobot, if it is missing."""
    if importlib.util.find_spec("lerobot") is None:
        raise ValueError("LeRobot is missing: pip install 'lerobot[training,evaluation]', with Python 3.12 or later")


def find_demonstrations(path: Path, task: str, env: GoalEnv) -> Demonstrations:
    """Reads demonstrations of a task from a file of this package or a dataset of LeRobot's, which is a folder.

    Raises:
      FileNotFoundError: there is neither.
      ValueError: it holds none, or those of another task; or LeRobot is missing.
    """
    if not path.is_dir():
        return load_demonstrations(path, task).validate(env)
    check_installed()
    from hgail_jax.lerobot.dataset import read_dataset

    return read_dataset(path, task, env)

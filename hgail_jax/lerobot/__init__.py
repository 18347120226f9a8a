"""The bridge to LeRobot, which finds it by `--env.discover_packages_path=hgail_jax.lerobot`; see `docs/lerobot.md`.

LeRobot, and with it PyTorch, is no dependency of this package: only the modules in here import it.
"""

import importlib.util
from pathlib import Path

from hgail_envs import GoalEnv
from hgail_envs.registry import make
from hgail_envs.vision.camera_env import known_numbers
from hgail_jax.io.demonstrations import Demonstrations, load_demonstrations
from hgail_jax.io.policy import AnyPolicy
from hgail_jax.vision.policy import CameraPolicy


def check_installed() -> None:
    """Raises a ValueError that says how to install LeRobot, if it or one of its extras is missing."""
    missing = [name for name in ("lerobot", "datasets", "av") if importlib.util.find_spec(name) is None]
    if missing:
        install = "pip install 'lerobot[training,evaluation]~=0.6.1', with Python 3.12 or later"
        raise ValueError(f"LeRobot is missing, or a part of it ({', '.join(missing)}): {install}")


def check_shown(policy: AnyPolicy) -> None:
    """Raises a ValueError unless a policy reads what LeRobot's environment of its task shows, on its robot."""
    if isinstance(policy, CameraPolicy) and policy.kind != "colour":
        raise ValueError(f"the policy sees {policy.kind}; LeRobot's environment of {policy.task} shows colours")
    env = make(policy.task, **{name: value for name, value in policy.task_options.items() if name == "robot"})
    shown = known_numbers(env, policy.target).size if isinstance(policy, CameraPolicy) else env.observation_size
    if policy.mean.size != shown:
        raise ValueError(
            f"the policy reads {policy.mean.size} numbers; LeRobot's environment of {policy.task} shows {shown}:"
            " policies that read the past, or were trained with options such as cube=tracked, cannot be exported"
        )


def find_demonstrations(path: Path, task: str, env: GoalEnv) -> Demonstrations:
    """Reads demonstrations of a task from a file of this package or a dataset of LeRobot's, which is a folder.

    Raises:
      FileNotFoundError: there is neither.
      ValueError: it holds none, or those of another task; or LeRobot is missing.
    """
    if not path.is_dir():
        return load_demonstrations(path, task).validate(env)
    if not (path / "meta" / "info.json").is_file():
        raise ValueError(f"{path} is no LeRobotDataset: it has no meta/info.json")
    check_installed()
    from hgail_jax.lerobot.dataset import read_dataset

    return read_dataset(path, task, env)

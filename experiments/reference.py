"""Gymnasium-Robotics' environments, the reference of this project's tasks."""

from types import SimpleNamespace
from typing import Any

import mujoco


def make_reference(name: str, **options: Any) -> Any:
    """Makes an environment of Gymnasium-Robotics, on whatever MuJoCo is installed.

    Args:
      name: e.g. `"FetchReach-v4"`.
      options: of `gymnasium.make`.

    Raises:
      ImportError: the extra `compare` is not installed.

    """
    import gymnasium  # here, so that this module imports without the extra
    import gymnasium_robotics
    from gymnasium_robotics.utils import mujoco_utils

    # It tests whether a NumPy integer is `in` a tuple of joint types, which newer MuJoCos' enums never equal.
    kinds = {name: int(kind) for name, kind in mujoco.mjtJoint.__members__.items()}
    mujoco_utils.mujoco = SimpleNamespace(**vars(mujoco) | {"mjtJoint": SimpleNamespace(**kinds)})
    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make(name, **options)

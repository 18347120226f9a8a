"""Gymnasium-Robotics' environments, which the tasks of this package are held to."""

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
    import gymnasium  # here, so that those who can do without the extra can import this
    import gymnasium_robotics
    from gymnasium_robotics.utils import mujoco_utils

    # It asks whether a NumPy integer is `in` a tuple of kinds of joints. Of those of newer MuJoCos it never is.
    kinds = {name: int(kind) for name, kind in mujoco.mjtJoint.__members__.items()}
    mujoco_utils.mujoco = SimpleNamespace(**vars(mujoco) | {"mjtJoint": SimpleNamespace(**kinds)})
    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make(name, **options)

"""The cameras of a scene, by their names; where those of the package stand, `assets/scenes/room.xml` says."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

DEFAULT_CAMERAS = ("front", "side")
"""Cameras of a policy that sees pictures, unless others are named."""


def camera_ids(model: mujoco.MjModel, scene: str, names: Sequence[str]) -> list[int]:
    """Returns the numbers of cameras in a model; a ValueError if there are none, one is unknown or named twice."""
    if isinstance(names, str):
        raise ValueError(f"cameras is {names!r}; it must be a sequence of names, such as [{names!r}]")
    there = [model.camera(index).name for index in range(model.ncam)]
    if not there:
        raise ValueError(f"scene {scene} has no camera; give its MJCF a <camera> with a name, a pose and a fovy")
    if not names:
        raise ValueError(f"no camera is named; choose from {', '.join(there)}")
    for name in names:
        if name not in there:
            raise ValueError(f"scene {scene} has no camera {name!r}; it has {', '.join(there)}")
    if len(set(names)) < len(names):
        raise ValueError(f"a camera is named twice in {', '.join(names)}")
    return [there.index(name) for name in names]


def describe_cameras(model: mujoco.MjModel, names: Sequence[str], size: int) -> list[dict[str, Any]]:
    """Returns the pose and the intrinsics of cameras with square pictures, as JSON has them.

    The pose is in the frame of a body, `"world"` for a camera that stands still: the position in metres and the
    rotation as a matrix whose columns are the picture's axes, x to the right, y up, and z, towards the viewer. The
    intrinsics are in pixels, with the origin at the upper left corner.
    """
    return [_describe(model, name, size) for name in names]


def _describe(model: mujoco.MjModel, name: str, size: int) -> dict[str, Any]:
    camera, rotation = model.camera(name), np.empty(9)
    mujoco.mju_quat2Mat(rotation, camera.quat)
    fovy = float(camera.fovy[0])
    focal = size / 2 / float(np.tan(np.deg2rad(fovy) / 2))
    return {
        "name": name,
        "body": model.body(int(camera.bodyid[0])).name,
        "position": np.round(camera.pos, 6).tolist(),
        "rotation": np.round(rotation.reshape(3, 3), 6).tolist(),
        "fovy": fovy,
        "intrinsics": {"fx": focal, "fy": focal, "cx": size / 2, "cy": size / 2},
    }

"""Scenes: a table and objects around a robot, as MJCF, and pictures of them.

They are found in a checkout and in an installed wheel alike.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from hgail_envs.base import GoalEnv
from hgail_envs.vision.rendering import open_renderer

TABLE_HEIGHT = 0.4
"""Metres from the floor to the table's top, in every scene."""

_CAMERA_DISTANCE = 2.15  # in a scene's extent; the arm stays in the picture wherever it goes
_CAMERA_RISE = 0.06  # metres from a scene's centre to the picture's, for the elbow
_SIZE = (480, 640)  # height, width
VISUAL_GROUP = 2
"""Group of geoms that collide with nothing."""


def assets_directory() -> Path:
    """Returns the folder of the scenes: `hgail_envs/assets` in a wheel, `assets` of the repository in a checkout."""
    package = Path(__file__).resolve().parent
    installed = package / "assets"
    return installed if installed.is_dir() else package.parent.parent / "assets"


def read_scene(name: str, parts: Mapping[str, bytes]) -> mujoco.MjSpec:
    """Reads the scene `assets/scenes/<name>.xml`, with the files of a robot that it includes, by their names there."""
    return mujoco.MjSpec.from_file(str(assets_directory() / "scenes" / f"{name}.xml"), include=parts)


def without_visuals(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Returns a scene without the geoms that have no effect."""
    for geom in [geom for geom in spec.geoms if geom.group == VISUAL_GROUP]:
        spec.delete(geom)
    for mesh in list(spec.meshes):  # they alone use meshes, which take long to compile
        spec.delete(mesh)
    return spec


def free_camera(model: mujoco.MjModel) -> mujoco.MjvCamera:
    """Returns the camera that shows the arm wherever it goes."""
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    camera.distance = _CAMERA_DISTANCE * model.stat.extent
    camera.lookat[2] += _CAMERA_RISE
    return camera


class SceneView:
    """Pictures of a task's scene in given poses, with the `render_mode` `"rgb_array"`; a ValueError if it has none."""

    def __init__(self, env: GoalEnv, render_mode: str | None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is {render_mode!r}; it must be None or 'rgb_array'")
        if render_mode is not None and env.robot is None:
            raise ValueError("the task has no scene to show")
        self._env = env
        self._renderer: mujoco.Renderer | None = None

    def picture(self, qpos: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Returns the scene with joints at `qpos` and the target at `goal`, `[480, 640, 3]`, uint8."""
        if self._renderer is None:
            self.model, self.data = open_scene(self._env)
            self._renderer, self._camera = open_renderer(self.model, *_SIZE), free_camera(self.model)
        pose(self.model, self.data, qpos, goal)
        self._renderer.update_scene(self.data, self._camera)
        return self._renderer.render()

    def __reduce__(self) -> tuple[Any, ...]:
        return SceneView, (self._env, None)

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None


def open_scene(env: GoalEnv) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Returns a task's scene with its visual geoms; the target's marker is hidden where a body is the target."""
    if env.robot is None:
        raise ValueError("the task has no scene to show")
    model = env.robot.load(visual=True)
    if env.target_body is not None:
        model.site("target").rgba[3] = 0.0
    return model, mujoco.MjData(model)


def pose(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray, goal: np.ndarray) -> None:
    """Poses a scene of `open_scene` for a picture, with the target's marker at `goal`, `[goal_size]`."""
    model.site("target").pos = goal[:3]
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)

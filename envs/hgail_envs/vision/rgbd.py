"""Takes pictures of a scene with MuJoCo's renderer: colour, depth, and which object each pixel shows.

MuJoCo needs EGL or OSMesa to render without a display; `open_renderer` raises an error that says so.

    camera = look_at(position, target, fovy=45.0, width=128, height=128)
    with Photographer(model, camera.width, camera.height) as photographer:
        picture = photographer.shoot(data, camera)
"""

import contextlib
import copy
import ctypes.util
import dataclasses
import importlib
import os
import sys
import warnings
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from hgail_envs.vision.camera import Camera

Stage = Callable[[mujoco.MjvScene], None]
"""Edits a scene before it is rendered: adds shapes, paints, moves lights. The model stays as it is."""

_BACKENDS = ("egl", "osmesa", "glfw")  # of MUJOCO_GL, on Linux
_SHADOW_SIZE = 1024  # texels; nearly all the time of a picture is its shadows
_SHAPE_ID = 1_000_000  # first id in a segmentation of shapes that are not in the model


@dataclasses.dataclass(frozen=True)
class Picture:
    """Picture of an RGB-D camera."""

    rgb: np.ndarray
    """`[height, width, 3]`, uint8."""
    depth: np.ndarray
    """`[height, width]`, float32, along the optical axis, metres."""


class RenderingError(RuntimeError):
    """Error of a machine on which MuJoCo cannot render; the message names a remedy."""


def open_renderer(model: mujoco.MjModel, height: int, width: int) -> "mujoco.Renderer":
    """Opens MuJoCo's renderer.

    Raises:
      RenderingError: MuJoCo cannot render here.

    """
    try:
        _choose_backend()
        # Not `mujoco.Renderer`, which is missing, without a reason, where the backend could not be imported at first.
        renderer: Any = importlib.import_module("mujoco.rendering.classic.renderer")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW warns of a display that does not answer, then the renderer fails
            return renderer.Renderer(model, height, width)
    except Exception as error:  # whatever the GL backend raises; each has exceptions of its own
        display, chosen = os.environ.get("DISPLAY"), os.environ.get("MUJOCO_GL")
        if chosen and chosen.strip().lower() not in _BACKENDS:
            raise RenderingError(
                f"MuJoCo cannot render: MUJOCO_GL is {chosen!r}; choose from {', '.join(_BACKENDS)}"
            ) from error
        if display and chosen is None:
            raise RenderingError(
                f"MuJoCo cannot render on DISPLAY={display}; set MUJOCO_GL=egl or MUJOCO_GL=osmesa ({error})"
            ) from error
        raise RenderingError(f"MuJoCo cannot render here, install EGL or OSMesa ({error})") from error


def _choose_backend() -> None:
    """Sets `MUJOCO_GL` to EGL or OSMesa where neither it nor a display says with what to render.

    MuJoCo reads it when it is imported, and takes GLFW if it is not set, which needs a display.
    """
    if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("MUJOCO_GL"):
        return
    backend = headless_backend(ctypes.util.find_library)
    if backend is not None:
        os.environ["MUJOCO_GL"] = backend
        used: Any = importlib.import_module("mujoco.rendering.classic.gl_context")  # by MuJoCo's renderer
        used.GLContext = importlib.import_module(f"mujoco.{backend}").GLContext


def headless_backend(find_library: Callable[[str], str | None]) -> str | None:
    """Returns the backend for rendering without a display: `"egl"`, `"osmesa"`, or None if neither is installed.

    >>> headless_backend({"OSMesa": "libOSMesa.so.8"}.get)
    'osmesa'
    """
    return next((library.lower() for library in ("EGL", "OSMesa") if find_library(library)), None)


class Photographer(contextlib.AbstractContextManager):
    """Renders a model from any pose; for use in one thread, and to be closed.

    Args:
      model: any scene; its visible groups are in the pictures, except sites.
      width: width of the pictures, pixels.
      height: height of the pictures, pixels.

    Raises:
      RenderingError: MuJoCo cannot render here.

    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        model = copy.copy(model)
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, height)
        model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, _SHADOW_SIZE)
        self.model = model
        self._renderer = open_renderer(model, height, width)
        self._options = mujoco.MjvOption()
        self._options.sitegroup[:] = 0

    def __exit__(self, *exception) -> None:
        self.close()

    def close(self) -> None:
        """Frees the renderer."""
        self._renderer.close()

    def shoot(self, data: mujoco.MjData, camera: Camera, stage: Stage | None = None) -> Picture:
        """Takes a picture of a scene whose kinematics are computed (`mujoco.mj_forward` does it)."""
        self._compose(data, camera, stage)
        rgb = self._renderer.render()
        self._renderer.enable_depth_rendering()
        depth = self._renderer.render()
        self._renderer.disable_depth_rendering()
        return Picture(rgb, depth)

    def segment(self, data: mujoco.MjData, camera: Camera, stage: Stage | None = None) -> np.ndarray:
        """Returns the id of each pixel's geom, or of its shape from `add_shape`, or -1: `[height, width]`."""
        self._compose(data, camera, stage)
        self._renderer.enable_segmentation_rendering()
        objects = self._renderer.render()
        self._renderer.disable_segmentation_rendering()
        return np.where(objects[..., 1] == mujoco.mjtObj.mjOBJ_GEOM, objects[..., 0], -1)

    def _compose(self, data: mujoco.MjData, camera: Camera, stage: Stage | None) -> None:
        if (camera.width, camera.height) != (self._renderer.width, self._renderer.height):
            raise ValueError(f"the camera has {camera.width} by {camera.height} pixels, the renderer has others")
        self._renderer.update_scene(data, scene_option=self._options)
        scene = self._renderer.scene
        _place_camera(self.model, scene, camera)
        if stage is not None:
            stage(scene)


def add_shape(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    size: np.ndarray,
    position: np.ndarray,
    rgba: np.ndarray,
    rotation: np.ndarray | None = None,
) -> int:
    """Adds a shape that is only in the picture, and returns its id in a segmentation.

    Args:
      scene: the scene to be rendered.
      kind: kind of geom.
      size: `[3]`, as of a MuJoCo geom, metres.
      position: `[3]`, metres, world frame.
      rgba: `[4]`, colour.
      rotation: `[3, 3]`; None is upright.

    """
    index = scene.ngeom
    geom = scene.geoms[index]
    axes = np.eye(3) if rotation is None else rotation
    mujoco.mjv_initGeom(
        geom, kind, np.asarray(size, float), np.asarray(position, float), axes.flatten(), np.asarray(rgba, np.float32)
    )
    geom.segid, geom.objtype, geom.objid = index, mujoco.mjtObj.mjOBJ_GEOM, _SHAPE_ID + index
    scene.ngeom += 1
    return geom.objid


def _place_camera(model: mujoco.MjModel, scene: mujoco.MjvScene, camera: Camera) -> None:
    """Gives the scene the camera's pose and view, and its headlight the camera's place."""
    _, down, forward = camera.rotation.T
    near, far = model.vis.map.znear * model.stat.extent, model.vis.map.zfar * model.stat.extent
    (focal_x, _, middle_x), (_, focal_y, middle_y) = camera.matrix[:2]
    for view in scene.camera:  # a left and a right one, of which MuJoCo takes the mean
        view.pos, view.forward, view.up = camera.position, forward, -down
        view.frustum_near, view.frustum_far = near, far
        view.frustum_bottom = -near * (camera.height - middle_y) / focal_y
        view.frustum_top = near * middle_y / focal_y
        view.frustum_center = near * (camera.width / 2 - middle_x) / focal_x
        view.frustum_width = near * camera.width / 2 / focal_x
    for light in scene.lights[: scene.nlight]:
        if light.headlight:
            light.pos, light.dir = camera.position, forward

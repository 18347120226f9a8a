"""A picture of a robot and of its hand, with the axes that its description says."""

from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from hgail_envs import GoalEnv
from hgail_envs.scenes import free_camera, open_scene
from hgail_envs.vision.rendering import open_renderer
from hgail_jax.io.files import replace_path

_SIZE = (480, 640)  # height, width
_OF_PARTS = 4  # group of the pads and the palm
_SEE_THROUGH = 0.35  # alpha of theirs, through which the hand and the axes are seen
_AXES = (("points", (0.9, 0.1, 0.1, 1.0)), ("closes", (0.1, 0.65, 0.2, 1.0)))  # colours of the tool's x and y
_LENGTH, _WIDTH = 0.12, 0.004  # metres
_NEAR = 0.55  # metres from the hand to the second camera


def portrait(path: Path, env: GoalEnv) -> None:
    """Writes a picture of a task's robot at its start, and beside it its hand with pads, palm and axes.

    A red arrow shows where the hand points, a green one along what it closes.
    """
    model, data = open_scene(env)
    data.qpos[:] = np.asarray(env.robot.settle().qpos)
    mujoco.mj_forward(model, data)
    whole, near = free_camera(model), free_camera(model)
    near.lookat[:], near.distance = data.site("grip").xpos, _NEAR
    near.elevation = -12
    options = mujoco.MjvOption()
    options.geomgroup[_OF_PARTS] = 1
    model.geom_rgba[model.geom_group == _OF_PARTS, 3] = _SEE_THROUGH
    model.geom("table_top").rgba[3] = 0.0
    with open_renderer(model, *_SIZE) as renderer:
        pictures = []
        for camera, option in ((whole, mujoco.MjvOption()), (near, options)):
            renderer.update_scene(data, camera, option)
            if option is options:
                _add_axes(renderer.scene, data)
            pictures.append(renderer.render())
    with replace_path(path) as temporary:
        Image.fromarray(np.hstack(pictures)).save(temporary, format="png")


def _add_axes(scene: mujoco.MjvScene, data: mujoco.MjData) -> None:
    start, axes = data.site("grip").xpos, data.site("grip").xmat.reshape(3, 3).T
    for axis, (_, colour) in zip(axes, _AXES, strict=False):
        arrow = scene.geoms[scene.ngeom]
        kind, nothing = mujoco.mjtGeom.mjGEOM_ARROW, np.zeros(3)
        mujoco.mjv_initGeom(arrow, kind, nothing, nothing, np.eye(3).ravel(), np.array(colour, np.float32))
        mujoco.mjv_connector(arrow, kind, _WIDTH, start, start + _LENGTH * axis)
        scene.ngeom += 1

"""Pictures of Gymnasium-Robotics' scenes, with their meshes, materials and light, by the cameras of ours."""

import atexit
import weakref
from collections.abc import Sequence

import mujoco
import numpy as np

from hgail_envs.base import GoalEnv
from hgail_envs.tasks.reference import ReferenceFetch
from hgail_envs.vision.cameras import camera_ids
from hgail_envs.vision.depth import as_picture
from hgail_envs.vision.rendering import open_renderer

_BODIES = {"world": "world", "gripper": "robot0:gripper_link"}
"""Bodies of the Fetch that cameras may be fixed to, and their names in the reference."""


class ReferencePictures:
    """What cameras of a task's scene would see in the reference's: called, it renders the present state.

    Returns pictures of a `kind` as `hgail_envs.vision.pictures.Pictures` does, uint8 `[cameras, size, size, 3]`, or of
    depth `[cameras, size, size, 1]`. Each camera has the pose and the field of view that it has in the task's scene.
    With `marker` they show the target's ball.

    Raises:
      ValueError: the scene has no such camera, or one that is fixed to a body that the reference has not.
      RenderingError: MuJoCo cannot render here.
    """

    def __init__(
        self,
        reference: ReferenceFetch,
        task: GoalEnv,
        cameras: Sequence[str],
        size: int,
        marker: bool,
        kind: str = "colour",
    ) -> None:
        ours, spec = task.robot.load(visual=True), mujoco.MjSpec.from_file(reference.scene)
        camera_ids(ours, task.robot.scene, cameras)
        for name in cameras:
            camera = ours.camera(name)
            body = ours.body(int(camera.bodyid[0])).name
            if body not in _BODIES:
                raise ValueError(f"camera {name!r} is fixed to the body {body!r}, which the reference has not")
            spec.body(_BODIES[body]).add_camera(name=name, pos=camera.pos, quat=camera.quat, fovy=camera.fovy[0])
        self._reference, self._cameras, self._model = reference, tuple(cameras), spec.compile()
        self._data, self._option = mujoco.MjData(self._model), mujoco.MjvOption()
        self._option.sitegroup[:] = int(marker)
        self._renderer, self._depth = open_renderer(self._model, size, size), kind == "depth"
        if self._depth:
            self._renderer.enable_depth_rendering()
        # At the end of the process it must be closed before MuJoCo closes EGL, else each complains of the other.
        atexit.register(weakref.finalize(self, self._renderer.close))

    def __call__(self) -> np.ndarray:
        model, data, theirs = self._model, self._data, self._reference.data
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = theirs.qpos, theirs.mocap_pos, theirs.mocap_quat
        target = model.site("target0")
        target.pos = self._reference.target() - model.body(int(target.bodyid[0])).pos  # it stands still
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        pictures = []
        for camera in self._cameras:
            self._renderer.update_scene(data, camera, self._option)
            pictures.append(self._renderer.render())
        return as_picture(np.stack(pictures))[..., None] if self._depth else np.stack(pictures)

"""MuJoCo's OpenGL renderer, called back on the host from within a compiled program on a CPU."""

import atexit
import copy
import functools
import weakref
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from hgail_envs.engines.c import digest
from hgail_envs.engines.host_call import host_call
from hgail_envs.vision.depth import as_picture
from hgail_envs.vision.look import FIELDS, Look, varied
from hgail_envs.vision.rendering import open_renderer

_FACETS = 14, 8, 1  # of a round shape, around, along and across: finer ones are smaller than a pixel
_SHADOW, _SAMPLES = 512, 4  # most texels along a shadow and samples in a pixel; the scenes' are for large pictures


class OpenGLRenderer:
    """Renders one scene after another, with MuJoCo's sky and shadows.

    Called with joint positions, `[N, nq]`, and draws of looks, `[N, draws]`, it returns pictures, uint8 `[N, cameras *
    size * size * 3]`, or with `depth` those of `hgail_envs.vision.depth`, `[N, cameras * size * size]`. A
    RenderingError says that MuJoCo cannot render here.
    """

    def __init__(self, model: mujoco.MjModel, cameras: list[int], size: int, look: Look, depth: bool = False) -> None:
        self._model, self._cameras, self._size, self._depth = copy.copy(model), cameras, size, depth
        self._vary = functools.partial(varied, model, look, xp=np)
        name = "depth" if depth else "pictures"
        self._name = ".".join(map(str, [name, digest(model), *cameras, size, *vars(look).values()]))
        # An OpenGL context belongs to one thread, and XLA calls from any.
        self._thread = ThreadPoolExecutor(1)
        self._thread.submit(self._open).result()

    def _open(self) -> None:
        quality = self._model.vis.quality
        quality.shadowsize, quality.offsamples = min(quality.shadowsize, _SHADOW), min(quality.offsamples, _SAMPLES)
        quality.numslices, quality.numstacks, quality.numquads = _FACETS  # a third of the time, .3 of 255 apart
        self._renderer = open_renderer(self._model, self._size, self._size)
        if self._depth:
            self._renderer.enable_depth_rendering()
        # At the end of the process it must be closed before MuJoCo closes EGL, else each complains of the other.
        atexit.register(weakref.finalize(self, self._renderer.close))
        self._data, self._option = mujoco.MjData(self._model), mujoco.MjvOption()
        self._option.sitegroup[:] = 0

    def __call__(self, qpos: jax.Array, draws: jax.Array) -> jax.Array:
        pixels = len(self._cameras) * self._size**2
        result = jax.ShapeDtypeStruct((pixels if self._depth else 3 * pixels,), jnp.float32)

        def of_scene(qpos: jax.Array, draws: jax.Array) -> jax.Array:
            return host_call(self._name, self._on_host, [result], qpos, draws)[0]

        pictures = jax.vmap(of_scene)(jnp.asarray(qpos, jnp.float32), jnp.asarray(draws, jnp.float32))
        return pictures.astype(jnp.uint8)

    def _on_host(self, qpos: np.ndarray, draws: np.ndarray) -> tuple[np.ndarray]:
        scenes = list(zip(qpos.reshape(-1, qpos.shape[-1]), draws.reshape(-1, draws.shape[-1]), strict=True))
        pictures = self._thread.submit(lambda: np.stack([self._scene(*scene) for scene in scenes])).result()
        return (pictures.astype(np.float32).reshape(*qpos.shape[:-1], -1),)

    def _scene(self, qpos: np.ndarray, draws: np.ndarray) -> np.ndarray:
        """Returns the pictures of a scene, `[cameras, size, size, 3]`, or of depth `[cameras, size, size]`."""
        model, data = self._model, self._data
        look = self._vary(draws)
        for name in FIELDS:
            getattr(model, name)[:] = look[name]
        data.qpos[:] = np.nan_to_num(qpos)  # of a simulation that broke down
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        data.cam_xpos[:] += look["shift"]
        data.cam_xmat[:] = (data.cam_xmat.reshape(-1, 3, 3) @ look["turn"]).reshape(-1, 9)
        pictures = []
        for camera in self._cameras:
            self._renderer.update_scene(data, camera, self._option)
            pictures.append(self._renderer.render())
        return as_picture(np.stack(pictures)) if self._depth else np.stack(pictures)

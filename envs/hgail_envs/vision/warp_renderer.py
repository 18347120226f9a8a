"""MuJoCo Warp's ray tracer, which renders all scenes of a batch at once, on a GPU best."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from hgail_envs.vision.depth import as_picture
from hgail_envs.vision.look import FIELDS, Look, draws_of, varied
from hgail_envs.workarounds import promotion

OfBatch = Callable[..., jax.Array]
"""Arrays `[N, ...]` to an array `[N, ...]`."""

_GEOM_GROUPS = (0, 1, 2)  # MuJoCo's own renderer draws these by default


def as_one_batch(function: OfBatch) -> OfBatch:
    """Returns a function that, under any number of vmaps, calls `function` once for the batches of all of them.

    So a library whose buffers are for a fixed number of rows, and that cannot be batched itself, sees a single batch.
    The function is traced once for each size on the way, and runs for the last alone.
    """
    batched = jax.custom_batching.custom_vmap(function)

    @batched.def_vmap
    def _(axis_size: int, is_batched: Sequence[bool], *arguments: jax.Array) -> tuple[jax.Array, bool]:
        whole = [
            values if there else jnp.broadcast_to(values, (axis_size, *values.shape))
            for values, there in zip(arguments, is_batched, strict=True)
        ]
        results = batched(*(values.reshape(-1, *values.shape[2:]) for values in whole))
        return results.reshape(axis_size, -1, *results.shape[1:]), True

    return batched


@jax.jit  # untraced, MJX-JAX takes some of the model's arrays, by their sizes, for constants
def _kinematics(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Returns the data with the poses of all geoms and cameras, in full single precision."""
    with jax.default_matmul_precision("highest"), promotion():
        return mjx.camlight(model, mjx.kinematics(model, data))


def _in_single(values: jax.Array) -> jax.Array:
    """Returns numbers in single precision, and truth values as they are."""
    return values if values.dtype == bool else values.astype(jnp.float32)


class WarpRenderer:
    """Renders all scenes of a batch at once; called as `hgail_envs.vision.opengl.OpenGLRenderer` is.

    Warp's buffers are for a fixed number of scenes, and it must render them outside of any vmap: see `as_one_batch`.
    """

    def __init__(self, model: mujoco.MjModel, cameras: list[int], size: int, look: Look, depth: bool = False) -> None:
        if np.any(model.light_bodyid):
            raise ValueError("the renderer 'warp' is for lights that stand still; fix the scene's to the world")
        self._model, self._cameras, self._size, self._look, self._depth = model, cameras, size, look, depth
        self._contexts: dict[int, Any] = {}  # by the number of scenes; freed with the renderer
        self._lock = threading.Lock()  # programs are traced in several threads
        with jax.ensure_compile_time_eval():
            # NumPy arrays: to make JAX's own constants of a program, JAX waits for the GPU.
            self._models = {impl: jax.device_get(mjx.put_model(model, impl=impl)) for impl in ("jax", "warp")}
            sizes = {"jax": {}, "warp": {"naconmax": 1, "njmax": 1}}  # no contact is looked for
            self._blank = {impl: jax.device_get(mjx.make_data(model, impl=impl, **sizes[impl])) for impl in sizes}
        self._render = as_one_batch(self._render_all)
        self._warm_up()

    def _warm_up(self) -> None:
        """Builds the kernels by a picture of one scene, before threads that build others begin; see `WarpEngine`."""
        draws = draws_of(self._model)
        jax.block_until_ready(jax.jit(self._render_all)(jnp.zeros((1, self._model.nq)), jnp.zeros((1, draws))))

    def __call__(self, qpos: jax.Array, draws: jax.Array) -> jax.Array:
        return self._render(qpos, draws)

    def _render_all(self, qpos: jax.Array, draws: jax.Array) -> jax.Array:
        model, look = self._models["warp"], varied(self._model, self._look, draws, jnp)
        model = model.tree_replace({name: _in_single(look[name]) for name in FIELDS if name != "light_dir"})
        data = jax.vmap(self._posed)(qpos, look["light_dir"], look["shift"], look["turn"])
        context = self._context(len(qpos))
        data = mjx.refit_bvh(model, data, context)
        packed, distance, _ = mjx.render(model, data, context)
        if self._depth:
            return as_picture(distance, jnp)
        channels = [(packed >> shift) & 0xFF for shift in (16, 8, 0)]
        return jnp.stack(channels, axis=-1).astype(jnp.uint8).reshape(len(qpos), -1)

    def _posed(self, qpos: jax.Array, light_dir: jax.Array, shift: jax.Array, turn: jax.Array) -> mjx.Data:
        """Returns Warp's data of a scene: the poses of its geoms, cameras and lights, by MJX-JAX."""
        posed = _kinematics(self._models["jax"], self._blank["jax"].replace(qpos=qpos))
        turned = jnp.matmul(posed.cam_xmat, turn, precision="highest")
        return self._blank["warp"].tree_replace(
            {
                "qpos": qpos,
                "geom_xpos": posed.geom_xpos,
                "geom_xmat": posed.geom_xmat,
                "cam_xpos": posed.cam_xpos + shift,
                "cam_xmat": turned,
                "_impl.light_xpos": jnp.asarray(self._model.light_pos, jnp.float32),
                "_impl.light_xdir": light_dir.astype(jnp.float32),
            }
        )

    def _context(self, scenes: int) -> Any:
        """Returns Warp's buffers for a number of scenes."""
        with self._lock:
            if scenes not in self._contexts:
                self._contexts[scenes] = mjx.create_render_context(
                    self._model,
                    nworld=scenes,
                    cam_res=(self._size, self._size),
                    cam_active=self._cameras,
                    render_rgb=not self._depth,
                    render_depth=self._depth,
                    use_textures=False,
                    use_shadows=self._look.shadows > 0.0,
                    shadow_light_fraction=0.0,  # by default light falls into a shadow, as it does not in OpenGL
                    enabled_geom_groups=list(_GEOM_GROUPS),
                    use_precomputed_rays=self._look.zoom == 0.0,
                )
            return self._contexts[scenes].pytree()

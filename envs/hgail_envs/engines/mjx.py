"""MJX's two implementations of the physics: MJX-JAX, which runs wherever XLA does, and MJX-Warp on NVIDIA GPUs."""

import copy
import importlib
from collections.abc import Mapping
from typing import Self

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from hgail_envs.engines.base import Control, Engine, StateT
from hgail_envs.engines.c import digest, usable_cores
from hgail_envs.engines.warp_kernels import MUJOCO_WARP, load_kernels
from hgail_envs.workarounds import keep_registered, promotion

_CALLED_BY_JAX = "mujoco.mjx.warp.ffi"  # has no kernels, but Warp, to 1.19.0, builds it all the same


@jax.jit  # traced once, whatever loops and batches it is then run in
def _step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Takes a physics step in full single precision: by default GPUs round factors of matrix products to ten bits."""
    with jax.default_matmul_precision("highest"), promotion():
        return mjx.step(model, data)


class MjxEngine(Engine):
    """MJX-JAX; see `Engine` for the arguments."""

    name = "jax"

    def __init__(self, model: mujoco.MjModel, period: float, substeps: int, worlds: int) -> None:
        super().__init__(model, period, substeps, worlds)
        self._check_pairs()
        # NumPy arrays: to make JAX's own constants of a program, JAX waits for the GPU, which may be loading kernels.
        self.mjx_model = jax.device_get(mjx.put_model(self.model, impl=self.name))
        self._blank_data = jax.device_get(mjx.make_data(self.model, impl=self.name, **self._buffer_sizes(worlds)))

    def _check_pairs(self) -> None:
        kinds = self.model.geom_type[np.stack([self.model.pair_geom1, self.model.pair_geom2])]
        cylinders, boxes = (kinds == kind for kind in (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_BOX))
        if (cylinders.any(axis=0) & boxes.any(axis=0)).any():
            raise ValueError("impl 'jax' collides no cylinder with a box, as this scene has them; use 'c' or 'warp'")

    def _buffer_sizes(self, worlds: int) -> dict[str, int]:
        return {}  # MJX-JAX sizes its arrays by the model alone

    def data(self, state: StateT, control: Control) -> mjx.Data:
        """Returns the data with which `mjx.step` carries out an action, together with `mjx_model`."""
        return jax.tree.map(_as_constant, self._blank_data).replace(
            qpos=state.qpos,
            qvel=state.qvel,
            qacc_warmstart=state.warmstart,
            mocap_pos=control.mocap_pos,
            mocap_quat=control.mocap_quat,
            ctrl=control.ctrl,
        )

    def step(self, state: StateT, control: Control) -> StateT:
        """Steps in a loop within the program; see `Engine`."""
        model = self._vary(control.model)
        # A constant number of steps: with a traced one a GPU would wait for the host before each.
        data = jax.lax.fori_loop(0, self.substeps, lambda _, data: _step(model, data), self.data(state, control))
        return state.replace(
            qpos=data.qpos,
            qvel=data.qvel,
            warmstart=data.qacc_warmstart,
            sensordata=data.sensordata,
            overflow=state.overflow | self._has_overflown(data),
        )

    def _vary(self, fields: Mapping[str, jax.Array] | None) -> mjx.Model:
        """Returns the model with some fields replaced, which alone are batched under `jax.vmap`."""
        if fields is None:
            return self.mjx_model
        self._check_fields(self.mjx_model, fields)
        own = {name: getattr(self.mjx_model, name) for name in fields}  # shapes differ between implementations
        return self.mjx_model.tree_replace(
            {name: values.reshape(own[name].shape).astype(own[name].dtype) for name, values in fields.items()}
        )

    def _has_overflown(self, data: mjx.Data) -> jax.Array | bool:
        return False

    def with_substeps(self, substeps: int) -> Self:
        """Returns an engine that shares the model's arrays and the buffers; see `Engine`."""
        engine = object.__new__(type(self))
        vars(engine).update(vars(self))
        engine.substeps = substeps
        engine.model = copy.copy(self.model)
        engine.model.opt.timestep = self.period / substeps
        engine.mjx_model = self.mjx_model.tree_replace({"opt.timestep": np.float32(self.period / substeps)})
        return engine


class WarpEngine(MjxEngine):
    """MJX-Warp; see `Engine` for the arguments. More than `worlds` environments at once overflow its buffers."""

    name = "warp"

    def __init__(self, model: mujoco.MjModel, period: float, substeps: int, worlds: int) -> None:
        super().__init__(model, period, substeps, worlds)
        keep_registered(importlib.import_module("warp").Stream)
        self.max_worlds = worlds
        overflows = importlib.import_module(MUJOCO_WARP).OverflowType
        # Flags of full buffers. The solver stops at its limit of iterations by intent, which is flagged, and printed.
        self._buffer_flags = int(overflows.ALL & ~(overflows.ITERATIONS | overflows.LS_ITERATIONS))
        self.mjx_model = self.mjx_model.tree_replace({"opt._impl.warn_overflow": self._buffer_flags})

    def prepare(self) -> None:
        """Builds Warp's kernels, or finds them in its cache, and takes a step of one world outside of any program."""
        warp, sizes = importlib.import_module("warp"), buffer_sizes(self.model, worlds=1)
        device = warp.device_from_jax(jax.local_devices()[0])
        load_kernels(self.model, sizes, self._buffer_flags, device, digest(self.model), usable_cores())
        with warp.ScopedDevice(device):
            warp.load_module(warp.get_module(_CALLED_BY_JAX), device)
            warp.synchronize_device(device)

    def _check_pairs(self) -> None:
        return  # Warp collides all

    def _buffer_sizes(self, worlds: int) -> dict[str, int]:
        return buffer_sizes(self.model, worlds)

    def _has_overflown(self, data: mjx.Data) -> jax.Array | bool:
        return data._impl.overflow & self._buffer_flags != 0  # to 3.17.0 MJX passes Warp's flags on in no public field


def buffer_sizes(model: mujoco.MjModel, worlds: int) -> dict[str, int]:
    """Returns `make_data`'s bounds: the contacts of all worlds together and the constraint rows of one.

    A sphere touches anything in one point, a plane a box in at most four, two boxes touch in eight. A contact takes two
    rows per direction of its friction pyramid, with an elliptic cone fewer, a weld six rows, a limited joint one for
    each limit and a joint with friction one. A quarter of the rows is spare: a hand pressed into the cube has exceeded
    the count.
    """
    kinds = model.geom_type[np.stack([model.pair_geom1, model.pair_geom2])]
    spheres = (kinds == mujoco.mjtGeom.mjGEOM_SPHERE).any(axis=0)
    planes = (kinds == mujoco.mjtGeom.mjGEOM_PLANE).any(axis=0)
    points = np.where(spheres, 1, np.where(planes, 4, 8))
    rows = 6 * model.neq + 2 * int(model.jnt_limited.sum()) + int(np.count_nonzero(model.dof_frictionloss))
    rows += int(np.sum(points * 2 * (model.pair_dim - 1)))
    return {"naconmax": int(points.sum()) * worlds, "njmax": rows + rows // 4}


def _as_constant(values: np.ndarray) -> jax.Array:
    """Returns values as a constant of a program, a broadcast if all are equal: buffers are many megabytes."""
    if values.size and (values == values.flat[0]).all():
        return jnp.full(values.shape, values.flat[0], values.dtype)
    return jnp.asarray(values)

"""MuJoCo Warp by itself, without JAX, to be timed; needs warp-lang."""

import functools
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np

from hgail_envs.engines import Control, EngineState
from hgail_envs.engines.mjx import buffer_sizes

_KERNEL_SECONDS = 2e-6  # least time of a GPU from the start of a kernel to the next


class WarpLoop:
    """An episode of MuJoCo Warp without JAX: a CUDA graph of an action's physics steps, replayed for each action.

    Args:
      model: the scene, with its time step.
      substeps: physics steps per action.
      physics: at the start, `[N, ...]`.
      controls: of the scene, `[T, N, ...]`.
      options: changes to the fields of MuJoCo Warp's `opt`.

    """

    def __init__(
        self,
        model: mujoco.MjModel,
        substeps: int,
        physics: EngineState,
        controls: Control,
        options: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        import warp as wp  # not a dependency of the project
        from mujoco.mjx.third_party import mujoco_warp

        self._warp, self._engine = wp, mujoco_warp
        self._substeps, (self._num_actions, self._num_envs) = substeps, controls.ctrl.shape[:2]
        self._model = mujoco_warp.put_model(model)
        for name, value in options.items():
            setattr(self._model.opt, name, value)
        self._data = mujoco_warp.make_data(model, nworld=self._num_envs, **buffer_sizes(model, self._num_envs))
        self._start = {name: wp.array(np.asarray(getattr(physics, name)), dtype=float) for name in ("qpos", "qvel")}
        self._controls = {
            name: wp.array(np.asarray(values), dtype=getattr(self._data, name).dtype)
            for name, values in vars(controls).items()
            if values is not None and values.size
        }
        self._set(self._start)
        self._set_control(0)
        self.kernels = self._count_kernels()
        """Kernels of a physics step with all iterations of the solver."""
        self._replay = self._capture()

    def launch_floor(self) -> float:
        """Returns the environment steps per second if launching the kernels took all the time."""
        return self._num_envs / (self.kernels * _KERNEL_SECONDS * self._substeps)

    def __call__(self) -> None:
        """Steps from the start under all controls, and waits for the end."""
        self._set(self._start)
        for index in range(self._num_actions):
            self._set_control(index)
            self._replay()
        self._warp.synchronize()

    def positions(self) -> np.ndarray:
        """Returns the present joint positions, `[N, nq]`."""
        return self._data.qpos.numpy()

    def _set(self, values: dict[str, Any]) -> None:
        for name, array in values.items():
            self._warp.copy(getattr(self._data, name), array)

    def _set_control(self, index: int) -> None:
        self._set({name: values[index] for name, values in self._controls.items()})

    def _count_kernels(self) -> int:
        options, conditional = self._model.opt, self._model.opt.graph_conditional
        options.graph_conditional = False
        try:
            return _count_launches(lambda: self._engine.step(self._model, self._data))
        finally:
            options.graph_conditional = conditional

    def _act(self) -> None:
        for _ in range(self._substeps):
            self._engine.step(self._model, self._data)

    def _capture(self) -> Callable[[], Any]:
        """Returns a function that steps one action, on a GPU as a CUDA graph with a single launch."""
        self._act()  # once outside the graph, to compile the kernels
        if not self._warp.get_device().is_cuda:
            return self._act
        with self._warp.ScopedCapture() as capture:
            self._act()
        return functools.partial(self._warp.capture_launch, capture.graph)


def _count_launches(call: Callable[[], None]) -> int:
    """Returns the number of Warp kernels that a call launches."""
    import warp as wp

    count = 0

    def counting(launch: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*arguments: Any, **options: Any) -> Any:
            nonlocal count
            dim = options["dim"] if "dim" in options else arguments[1]
            count += bool(
                np.prod(dim)
            )  # an empty launch, e.g. for the tendons of a scene without any, starts no kernel
            return launch(*arguments, **options)

        return counted

    originals = {name: getattr(wp, name) for name in ("launch", "launch_tiled")}
    for name, launch in originals.items():
        setattr(wp, name, counting(launch))
    try:
        call()
    finally:
        for name, launch in originals.items():
            setattr(wp, name, launch)
    return count

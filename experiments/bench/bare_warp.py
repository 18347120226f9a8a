"""Times MuJoCo Warp by itself, without JAX; needs warp-lang."""

import functools
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from envs.engines import Control, EngineState
from envs.engines.mjx import buffer_sizes
from experiments.bench.timing import seconds_per_call

_KERNEL_SECONDS = 2e-6  # that a GPU takes at least from the start of a kernel to that of the next


def measure_warp_loop(
    model: mujoco.MjModel, substeps: int, physics: EngineState, controls: Control
) -> dict[str, float]:
    """Times MuJoCo Warp without JAX: a CUDA graph of an action's physics steps, replayed for each action.

    Args:
      model: the scene, with its time step.
      substeps: physics steps per action.
      physics: where it starts, `[N, ...]`.
      controls: what acts on the scene, `[T, N, ...]`.

    Returns:
      Environment steps per second; kernels that a physics step starts, and the environment steps per second that
      starting so many would allow.

    """
    import warp as wp  # not a dependency of the project
    from mujoco.mjx.third_party import mujoco_warp

    num_envs, num_actions = controls.ctrl.shape[:2]
    warp_model = mujoco_warp.put_model(model)
    data = mujoco_warp.make_data(model, nworld=num_envs, **buffer_sizes(model, num_envs))
    start = {name: wp.array(np.asarray(getattr(physics, name)), dtype=float) for name in ("qpos", "qvel")}
    given = {
        name: wp.array(np.asarray(values), dtype=getattr(data, name).dtype)
        for name, values in vars(controls).items()
        if values.size
    }

    def reset() -> None:
        for name, values in start.items():
            wp.copy(getattr(data, name), values)

    def control(index: int) -> None:
        for name, values in given.items():
            wp.copy(getattr(data, name), values[index])

    def act() -> None:
        for _ in range(substeps):
            mujoco_warp.step(warp_model, data)

    reset()
    control(0)
    kernels = _count_launches(lambda: mujoco_warp.step(warp_model, data))  # compiles them, too
    replay = _capture(act)

    def run() -> None:
        reset()
        for index in range(num_actions):
            control(index)
            replay()
        wp.synchronize()

    return {
        "bare_warp_env_steps_per_second": num_envs * num_actions / seconds_per_call(run),
        "kernels_per_substep": kernels,
        "launch_floor_env_steps_per_second": num_envs / (kernels * _KERNEL_SECONDS * substeps),
    }


def _capture(act: Callable[[], None]) -> Callable[[], Any]:
    """Returns a function that replays the kernels of `act` as a CUDA graph; on a CPU, `act` itself."""
    import warp as wp

    act()  # once outside the graph, which cannot hold what is allocated or compiled at first use
    if not wp.get_device().is_cuda:
        return act
    with wp.ScopedCapture() as capture:
        act()
    return functools.partial(wp.capture_launch, capture.graph)


def _count_launches(call: Callable[[], None]) -> int:
    """Returns how many kernels of Warp a call starts."""
    import warp as wp

    count = 0

    def counting(launch: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*arguments: Any, **options: Any) -> Any:
            nonlocal count
            count += 1
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

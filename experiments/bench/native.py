"""Measures MuJoCo Warp by itself, without JAX; needs warp-lang."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from envs.fetch.arm import FetchEnv, FetchPhysics, buffer_sizes
from experiments.bench.timing import seconds_per_call

_KERNEL_SECONDS = 2e-6  # that a GPU takes at least from the start of a kernel to that of the next


def measure_native(env: FetchEnv, physics: FetchPhysics, controls: dict[str, jax.Array]) -> dict[str, float]:
    """Times MuJoCo Warp without JAX: a CUDA graph of one action's steps, replayed, on the same controls."""
    import warp as wp
    from mujoco.mjx.third_party import mujoco_warp

    num_envs = len(physics.qpos)
    model = mujoco_warp.put_model(env.model)
    data = mujoco_warp.make_data(env.model, nworld=num_envs, **buffer_sizes(env.model, num_envs))
    given = {
        name: wp.array(np.asarray(values), dtype=getattr(data, name).dtype)
        for name, values in controls.items()
        if values.size
    }
    start = {name: wp.array(np.asarray(getattr(physics, name)), dtype=float) for name in ("qpos", "qvel")}

    def advance():
        for _ in range(env.substeps):
            mujoco_warp.step(model, data)

    def begin(time):
        for name, values in given.items():
            wp.copy(getattr(data, name), values[time])

    for name, values in start.items():
        wp.copy(getattr(data, name), values)
    begin(0)
    kernels = _count_launches(lambda: mujoco_warp.step(model, data))
    advance()
    replay: Callable[[], Any] = advance
    if wp.get_device().is_cuda:
        with wp.ScopedCapture() as capture:
            advance()
        replay = functools.partial(wp.capture_launch, capture.graph)

    def run():
        for name, values in start.items():
            wp.copy(getattr(data, name), values)
        for time in range(env.episode_length):
            begin(time)
            replay()
        wp.synchronize()

    seconds = seconds_per_call(run)
    return {
        "bare_warp_env_steps_per_second": num_envs * env.episode_length / seconds,
        "kernels_per_substep": kernels,
        "launch_floor_env_steps_per_second": num_envs / (kernels * _KERNEL_SECONDS * env.substeps),
    }


def _count_launches(call: Callable[[], Any]) -> int:
    """Returns how many kernels of Warp a call starts."""
    import warp as wp

    count = 0

    def counting(launch):
        def call(*arguments, **options):
            nonlocal count
            count += 1
            return launch(*arguments, **options)

        return call

    originals = {name: getattr(wp, name) for name in ("launch", "launch_tiled")}
    for name, launch in originals.items():
        setattr(wp, name, counting(launch))
    try:
        call()
    finally:
        for name, launch in originals.items():
            setattr(wp, name, launch)
    return count

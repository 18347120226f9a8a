"""Builds the kernels of MuJoCo Warp before the first step needs them."""

import importlib
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import mujoco

_PACKAGE = "mujoco.mjx.third_party.mujoco_warp"
_LARGEST = ("smooth", "sensor", "solver", "passive", "forward", "support")


def build_kernels(model: mujoco.MjModel, sizes: dict[str, int]) -> None:
    """Builds the kernels that a physics step of a model takes, or finds them in Warp's cache.

    Warp builds a module of kernels when one of them is first launched, one module after another: on a fresh machine
    most of a minute. The largest are built here side by side; a step of one world, outside of any program, asks for the
    others, which Warp writes for the model.

    Args:
      model: the scene.
      sizes: of the buffers, see `envs.engines.mjx.buffer_sizes`; their number of rows is in the kernels.

    Raises:
      Exception: as Warp raises it, where a module cannot be built.

    """
    warp, mujoco_warp = importlib.import_module("warp"), importlib.import_module(_PACKAGE)
    names = [f"{_PACKAGE}._src.{module}" for module in _LARGEST]
    modules = [warp.get_module(name) for name in names if name in sys.modules]
    with warp.ScopedDevice(warp.device_from_jax(jax.local_devices()[0])) as device:
        load_side_by_side(modules, device)
        mujoco_warp.step(mujoco_warp.put_model(model), mujoco_warp.make_data(model, nworld=1, **sizes))
        warp.synchronize_device(device)


def generate_code_in_turn() -> None:
    """Has Warp generate code for one module at a time, while CUDA's compiler may be at work on others.

    Warp 1.14 notes what it knows of a function in one place for all modules that call it. Of two threads that build
    such modules at once, one now and then writes code that does not compile (NVIDIA/warp#1474). Call it before there
    are such threads; later versions, which have a lock of their own, are left as they are.
    """
    context: Any = importlib.import_module("warp._src.context")
    compiler: Any = importlib.import_module("warp._src.build")
    if hasattr(context, "_codegen_lock"):
        return
    context._codegen_lock = turn = threading.Lock()
    compile_cuda, load = compiler.build_cuda, context.Module.load

    def compile_beside(*args: Any, **options: Any) -> Any:
        turn.release()
        try:
            return compile_cuda(*args, **options)
        finally:
            turn.acquire()

    def load_in_turn(module: Any, *args: Any, **options: Any) -> Any:
        with turn:
            return load(module, *args, **options)

    compiler.build_cuda, context.Module.load = compile_beside, load_in_turn


def load_side_by_side(modules: Sequence[Any], device: Any) -> None:
    """Loads Warp's modules in a thread each, and raises what is wrong with one, which `warp.force_load` does not."""
    with ThreadPoolExecutor(len(modules)) as threads:
        list(threads.map(lambda module: module.load(device), modules))

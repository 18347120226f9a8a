"""Builds the kernels of MuJoCo Warp before the first step needs them."""

import importlib
import sys

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

    """
    warp, mujoco_warp = importlib.import_module("warp"), importlib.import_module(_PACKAGE)
    names = [f"{_PACKAGE}._src.{module}" for module in _LARGEST]
    modules = [warp.get_module(name) for name in names if name in sys.modules]
    with warp.ScopedDevice(warp.device_from_jax(jax.local_devices()[0])) as device:
        warp.force_load(device, modules, max_workers=len(modules))
        mujoco_warp.step(mujoco_warp.put_model(model), mujoco_warp.make_data(model, nworld=1, **sizes))
        warp.synchronize_device(device)

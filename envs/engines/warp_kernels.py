"""Builds the kernels of MuJoCo Warp ahead of the first step, several modules at once."""

import functools
import importlib
import sys
import threading

import jax

_PACKAGE = "mujoco.mjx.third_party.mujoco_warp._src"
_SLOWEST = ("smooth", "sensor", "solver", "passive", "forward", "support")
_THREADS = 4


@functools.cache
def start_building() -> threading.Thread | None:
    """Starts a thread that builds the largest modules, once in a process.

    Warp builds a module when one of its kernels is first launched, one after another: on a fresh machine most of a
    minute in which everything waits. This half of them is known before, and XLA compiles meanwhile. A module that the
    cache has is loaded; one that is needed before the thread is done is built twice, and nothing else happens.

    Returns:
      The thread, or None where MJX-Warp has not been imported.

    """
    names = [name for name in (f"{_PACKAGE}.{module}" for module in _SLOWEST) if name in sys.modules]
    if not names:
        return None
    warp = importlib.import_module("warp")
    devices = [warp.device_from_jax(device) for device in jax.local_devices()]
    modules = [warp.get_module(name) for name in names]
    thread = threading.Thread(
        target=warp.force_load,
        kwargs={"device": devices, "modules": modules, "max_workers": _THREADS},
        name="warp-kernels",
        daemon=True,
    )
    thread.start()
    return thread

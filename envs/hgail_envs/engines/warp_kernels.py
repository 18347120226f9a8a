"""Builds MuJoCo Warp's kernels, some forty modules, in several processes at once.

NVIDIA's compiler builds one module after another within a process, whatever the threads. Run as a script this file is
one of the processes, which replaces functions of Warp; to 1.19.0 they have no option for it (NVIDIA/warp#1977).
"""

import contextlib
import importlib
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import mujoco

MUJOCO_WARP = "mujoco.mjx.third_party.mujoco_warp"
_PROCESSES = 8  # each holds some hundred megabytes of the GPU's memory for its context
_PATIENCE = 300.0  # seconds; on an H200's server a single process needs 64 for all
_MODEL, _SETTINGS = "model.mjb", "settings.json"


def take_step(model: mujoco.MjModel, sizes: dict[str, int], buffer_flags: int) -> None:
    """Takes a step of one world on Warp's current device, for which Warp loads, and first builds, what it needs."""
    mujoco_warp = importlib.import_module(MUJOCO_WARP)
    data, warp_model = mujoco_warp.make_data(model, nworld=1, **sizes), mujoco_warp.put_model(model)
    warp_model.opt.warn_overflow = buffer_flags  # compiled into the kernels
    mujoco_warp.step(warp_model, data)


def load_kernels(
    model: mujoco.MjModel, sizes: dict[str, int], buffer_flags: int, device: Any, name: str, processes: int
) -> None:
    """Loads the kernels of `take_step` on a device of Warp; `processes`, eight at most, first build what is missing.

    A kernel that they fail to build is built here. When all are there, a folder in Warp's cache says so by the model's
    `name`, and the next start needs no process. `warp.clear_kernel_cache` removes it too, as all that begin with "wp_".
    """
    warp = importlib.import_module("warp")
    done = Path(warp.config.kernel_cache_dir, f"wp_hgail_envs_{name}_{device.arch}")
    if processes > 1 and not done.exists():
        with contextlib.suppress(OSError):  # e.g. no room for the model, or memory for processes
            build_kernels(model, sizes, buffer_flags, device.alias, processes)
    with warp.ScopedDevice(device):
        take_step(model, sizes, buffer_flags)
    with contextlib.suppress(OSError):  # a cache that was filled before may be read-only
        done.mkdir(exist_ok=True)


def build_kernels(model: mujoco.MjModel, sizes: dict[str, int], buffer_flags: int, device: str, processes: int) -> None:
    """Builds the kernels of `take_step` into Warp's cache by several processes; those of one that fails are left.

    A process that is not done in time, perhaps as it hangs, is killed.
    """
    warp = importlib.import_module("warp")
    settings = {"sizes": sizes, "buffer_flags": buffer_flags, "device": device, "cache": warp.config.kernel_cache_dir}
    with tempfile.TemporaryDirectory() as folder:
        mujoco.mj_saveModel(model, str(Path(folder, _MODEL)))
        Path(folder, _SETTINGS).write_text(json.dumps(settings))
        # -P: this file's neighbours are no top-level modules.
        command = [sys.executable, "-P", __file__, folder]
        null = subprocess.DEVNULL
        started: list[subprocess.Popen[bytes]] = []
        until = time.monotonic() + _PATIENCE
        try:
            for _ in range(min(_PROCESSES, processes)):
                started.append(subprocess.Popen(command, stdin=null, stdout=null, stderr=null))
            with contextlib.suppress(subprocess.TimeoutExpired):
                for process in started:
                    process.wait(max(0.0, until - time.monotonic()))
        finally:
            for process in started:
                process.kill()
                process.wait()


def _build_share(folder: Path) -> None:
    """Builds the modules that no other process has taken before; each takes the next one that is free."""
    warp: Any = importlib.import_module("warp")
    settings = json.loads((folder / _SETTINGS).read_text())
    warp.init()  # which would take another place for the root of its own
    warp.config.kernel_cache_dir = settings["cache"]
    module_type = importlib.import_module("warp._src.context").Module
    load = module_type.load

    def load_if_free(module: Any, device: Any, block_dim: int | None = None) -> None:
        """Returns None, with which Warp launches no kernel."""
        try:
            (folder / module.get_module_identifier(block_dim)).touch(exist_ok=False)
        except FileExistsError:
            return
        load(module, device, block_dim)

    suggested = warp.get_suggested_block_size

    def suggest(kernel: Any, device: Any) -> Any:
        """Returns a kernel's block size, for which it must be there; another process may have taken it."""
        module_type.load = load
        try:
            return suggested(kernel, device)
        finally:
            module_type.load = load_if_free

    module_type.load = load_if_free
    warp.get_suggested_block_size = suggest
    warp.capture_while = lambda condition, while_body, **arguments: while_body(**arguments)  # nothing is computed
    model = mujoco.MjModel.from_binary_path(str(folder / _MODEL))
    with warp.ScopedDevice(settings["device"]):
        take_step(model, settings["sizes"], settings["buffer_flags"])


if __name__ == "__main__":
    _build_share(Path(sys.argv[1]))

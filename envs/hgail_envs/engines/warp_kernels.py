"""Builds MuJoCo Warp's kernels, some forty modules, in several processes at once.

NVIDIA's compiler builds one module after another within a process, whatever the threads. Run as a script this file is
one of the processes.
"""

import hashlib
import importlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import mujoco

MUJOCO_WARP = "mujoco.mjx.third_party.mujoco_warp"
_PROCESSES = 8  # each holds some hundred megabytes of the GPU's memory for its context
_MODEL, _SETTINGS = "model.mjb", "settings.json"


def take_step(model: mujoco.MjModel, sizes: dict[str, int], buffer_flags: int) -> None:
    """Takes a step of one world on Warp's current device, for which Warp loads, and first builds, what it needs."""
    mujoco_warp = importlib.import_module(MUJOCO_WARP)
    data, warp_model = mujoco_warp.make_data(model, nworld=1, **sizes), mujoco_warp.put_model(model)
    warp_model.opt.warn_overflow = buffer_flags  # compiled into the kernels
    mujoco_warp.step(warp_model, data)


def build_kernels(model: mujoco.MjModel, sizes: dict[str, int], buffer_flags: int, device: str) -> None:
    """Builds the kernels of `take_step` into Warp's cache, once for a model; one that fails is left to `take_step`."""
    warp = importlib.import_module("warp")
    warp.init()
    cache = Path(warp.config.kernel_cache_dir)
    processes = min(_PROCESSES, len(os.sched_getaffinity(0)))
    with tempfile.TemporaryDirectory() as folder:
        mujoco.mj_saveModel(model, str(Path(folder, _MODEL)))
        built = cache / f"hgail_envs-{hashlib.sha256(Path(folder, _MODEL).read_bytes()).hexdigest()[:16]}"
        if built.exists() or processes == 1:
            return
        settings = {"sizes": sizes, "buffer_flags": buffer_flags, "device": device, "cache": str(cache)}
        Path(folder, _SETTINGS).write_text(json.dumps(settings))
        # -P: this file's neighbours are no top-level modules.
        command = [sys.executable, "-P", __file__, folder]
        null = subprocess.DEVNULL
        for process in [subprocess.Popen(command, stdin=null, stdout=null, stderr=null) for _ in range(processes)]:
            process.wait()
    built.parent.mkdir(parents=True, exist_ok=True)
    built.touch()


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

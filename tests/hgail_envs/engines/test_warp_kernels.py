"""Kernels of MuJoCo Warp built by several processes, on a GPU or, by Warp's own compiler, on a CPU."""

import contextlib
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import mujoco
import pytest

import hgail_envs
from hgail_envs.engines import warp_kernels
from hgail_envs.engines.mjx import buffer_sizes
from hgail_envs.engines.warp_kernels import build_kernels, load_kernels


def stand_in(cache):
    return SimpleNamespace(
        config=SimpleNamespace(kernel_cache_dir=str(cache)), ScopedDevice=lambda device: contextlib.nullcontext()
    )


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Loads kernels with stand-ins for Warp, the processes and the step; returns what was called of the last two."""
    called: list[str] = []

    def load(name="a", arch=90, processes=8, cache=tmp_path, build=lambda: None, step=lambda: None):
        monkeypatch.setitem(sys.modules, "warp", stand_in(cache))
        monkeypatch.setattr(warp_kernels, "build_kernels", lambda *_: called.append("build") or build())
        monkeypatch.setattr(warp_kernels, "take_step", lambda *_: called.append("step") or step())
        called.clear()
        load_kernels(None, {}, 1, SimpleNamespace(arch=arch, alias="cuda:0"), name, processes)
        return list(called)

    return load


def fail_with(error):
    def fail():
        raise error

    return fail


def test_processes_start_once_for_a_model_and_a_kind_of_gpu(load):
    assert load() == ["build", "step"]
    assert load() == ["step"]
    assert load(name="b") == ["build", "step"]
    assert load(arch=80) == ["build", "step"]


def test_a_single_core_builds_in_the_process_itself(load):
    assert load(processes=1) == ["step"]


def test_after_a_start_that_was_interrupted_the_next_one_builds(load):
    with pytest.raises(KeyboardInterrupt):
        load(step=fail_with(KeyboardInterrupt))
    assert load() == ["build", "step"]


def test_a_step_follows_where_the_cache_or_the_disk_takes_no_file(load, tmp_path):
    (tmp_path / "file").touch()
    assert load(cache=tmp_path / "file") == ["build", "step"]
    assert load(build=fail_with(OSError("no space left on device"))) == ["build", "step"]


def test_processes_that_hang_are_ended_and_a_step_follows(tmp_path, monkeypatch):
    (tmp_path / "hang.py").write_text("import time; time.sleep(20)")
    popen, started, steps = subprocess.Popen, [], []

    def start(*arguments, **options):
        started.append(popen(*arguments, **options))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", start)
    monkeypatch.setattr(warp_kernels, "__file__", str(tmp_path / "hang.py"))
    monkeypatch.setattr(warp_kernels, "_PATIENCE", 0.1)
    monkeypatch.setattr(warp_kernels, "take_step", lambda *given: steps.append(given))
    monkeypatch.setitem(sys.modules, "warp", stand_in(tmp_path))
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    load_kernels(model, {}, 1, SimpleNamespace(arch=90, alias="cuda:0"), "a", 2)
    assert [process.returncode for process in started] == [-signal.SIGKILL] * 2
    assert steps == [(model, {}, 1)]


@pytest.mark.slow
def test_a_step_finds_all_its_kernels_built(tmp_path, monkeypatch):
    warp = pytest.importorskip("warp")
    warp.init()
    monkeypatch.setattr(warp.config, "kernel_cache_dir", str(tmp_path))
    model = hgail_envs.make("reach", impl="auto").engine.model
    arguments = model, buffer_sizes(model, worlds=1), 1
    device = warp.get_device("cuda:0" if jax.default_backend() == "gpu" else "cpu")

    def built():
        return sorted(path.name for path in Path(tmp_path).rglob("*.meta"))

    build_kernels(*arguments, device.alias, 8)
    before = built()
    assert len(before) > 20
    load_kernels(*arguments, device, "reach", 1)
    assert built() == before

    assert [*tmp_path.glob("wp_hgail_envs_*")]
    warp.clear_kernel_cache()
    assert not [*tmp_path.glob("wp_*")]  # so that the next start builds by processes again

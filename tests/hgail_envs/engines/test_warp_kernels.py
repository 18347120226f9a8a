"""Kernels of MuJoCo Warp built by several processes, on a GPU or, by Warp's own compiler, on a CPU."""

from pathlib import Path

import jax
import pytest

import hgail_envs
from hgail_envs.engines.mjx import buffer_sizes
from hgail_envs.engines.warp_kernels import build_kernels, take_step

warp = pytest.importorskip("warp")
pytestmark = pytest.mark.slow


def test_a_step_finds_all_its_kernels_built(tmp_path, monkeypatch):
    warp.init()
    monkeypatch.setattr(warp.config, "kernel_cache_dir", str(tmp_path))
    model = hgail_envs.make("reach", impl="auto").engine.model
    arguments = model, buffer_sizes(model, worlds=1), 1
    device = "cuda:0" if jax.default_backend() == "gpu" else "cpu"

    def built():
        return sorted(path.name for path in Path(tmp_path).rglob("*.meta"))

    build_kernels(*arguments, device)
    before = built()
    with warp.ScopedDevice(device):
        take_step(*arguments)
    assert len(before) > 20
    assert built() == before

    for path in tmp_path.rglob("*.meta"):
        path.unlink()
    build_kernels(*arguments, device)  # known as done, so that a start that finds all built starts no process
    assert not built()

"""The workarounds, and that what they work around does not come back."""

import ctypes.util
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hgail_envs import workarounds
from tests.support import ROOT


def test_xla_flags_only_where_the_fault_is():
    for version in ("0.7.2", "0.10.2"):
        assert workarounds.xla_flags("--a=1", version) == "--a=1 --xla_cpu_use_fusion_emitters=false"
        assert workarounds.thread_pool_size(2, version) == 8
    for version in ("0.6.2", "0.11.2", "0.12.0.1"):
        assert workarounds.xla_flags("--a=1", version) == "--a=1"
        assert workarounds.thread_pool_size(2, version) is None
    assert workarounds.thread_pool_size(16, "0.10.2") is None


def test_batched_cholesky_does_not_hang():
    """Three factorisations at once, each large enough to be spread over XLA's threads."""
    matrices = jnp.eye(13) * 2.0 + jnp.zeros((2000, 13, 13))

    @jax.jit
    def factorise(matrices):
        return sum(jnp.linalg.cholesky(matrices + shift * jnp.eye(13)).sum() for shift in (0.0, 1.0, 2.0))

    expected = 2000 * 13 * sum(np.sqrt([2.0, 3.0, 4.0]))
    assert float(factorise(matrices)) == pytest.approx(expected, rel=1e-4)


def test_a_cpu_dispatches_in_order():
    """Callbacks into C MuJoCo and asynchronous dispatch can wait for one another for ever."""
    assert not jax.config.read("jax_cpu_enable_async_dispatch")


def test_without_a_display_mujoco_renders_with_what_is_there():
    backend = workarounds.headless_backend(ctypes.util.find_library)
    if sys.platform != "linux" or backend is None:
        pytest.skip("neither EGL nor OSMesa")
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "MUJOCO_GL")}
    chosen = "from mujoco.rendering.classic import gl_context; print(gl_context.GLContext.__module__)"
    environment["PYTHONPATH"] = str(ROOT)
    options = {"env": environment, "capture_output": True, "text": True, "check": True}
    printed = subprocess.run([sys.executable, "-c", f"import mujoco, hgail_envs; {chosen}"], **options)
    assert f"mujoco.{backend}" in printed.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="a Mac has one renderer, which MUJOCO_GL does not choose")
@pytest.mark.parametrize(("first", "chosen"), [("hgail_envs", "bogus"), ("mujoco, hgail_envs", "disable")])
def test_physics_needs_no_renderer(first, chosen):
    lines = f"""
import {first}
from hgail_envs.scenes import load_scene
from hgail_envs.vision.rgbd import RenderingError, open_renderer
model = load_scene("fetch/reach")
try:
    open_renderer(model, 8, 8)
except RenderingError as error:
    print(error)
"""
    environment = os.environ | {"MUJOCO_GL": chosen, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", lines], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == f"MuJoCo cannot render: MUJOCO_GL is '{chosen}'; choose from egl, osmesa, glfw\n"


@pytest.mark.skipif(sys.platform != "linux", reason="a Mac has one renderer, which MUJOCO_GL does not choose")
def test_a_renderer_that_is_chosen_is_taken(rendering):
    backend = workarounds.headless_backend(ctypes.util.find_library)
    lines = "import hgail_envs, mujoco; print(mujoco.GLContext.__module__, mujoco.GLContext(8, 8) is None)"
    environment = os.environ | {"MUJOCO_GL": backend, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", lines], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == f"mujoco.{backend} False\n"

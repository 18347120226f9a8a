"""Works around faults of the installed JAX and MJX, before either has started."""

import contextlib
import ctypes.util
import importlib
import io
import os
import sys
from collections.abc import Callable, Iterator

import jax
import jaxlib.version

# Two faults of jaxlib's CPU backend, both fixed in the releases that Python 3.12 gets:
# - the fusion emitters duplicate work along the arm's kinematic chain, so that a batched MJX step compiles for minutes
#   and runs a thousand times slower (releases without the fault may abort on the flag as unknown);
# - a batched Cholesky factorisation waits, inside a thread of XLA's pool, for tasks that it puts into the same pool.
#   MJX has up to three at once, which deadlock on two cores. With more threads than that one is always free.
_FAULTY = [(0, minor) for minor in range(7, 11)]
_NO_FUSION_EMITTERS = "--xla_cpu_use_fusion_emitters=false"
_ENOUGH_THREADS = 8

rendering_fault: str | None = None
"""Reason for which MuJoCo cannot render with the value of `MUJOCO_GL`; None if it can, or if that is not known yet."""

# Shardy, JAX's default partitioner, crashes in these releases over a training step that several devices share.
_SHARDY_CRASHES = [(0, 11)]


def _release(version: str) -> tuple[int, int]:
    major, minor = version.split(".")[:2]
    return int(major), int(minor)


def xla_flags(flags: str, jaxlib_version: str) -> str:
    """Returns the XLA flags to run with, given those already set and jaxlib's version, e.g. `"0.10.2"`.

    >>> xla_flags("", "0.10.2")
    '--xla_cpu_use_fusion_emitters=false'
    >>> xla_flags("--xla_cpu_use_fusion_emitters=true", "0.10.2")
    '--xla_cpu_use_fusion_emitters=true'
    >>> xla_flags("", "0.12.0")
    ''
    """
    if "xla_cpu_use_fusion_emitters" in flags or _release(jaxlib_version) not in _FAULTY:
        return flags
    return f"{flags} {_NO_FUSION_EMITTERS}".strip()


def thread_pool_size(cores: int, jaxlib_version: str) -> int | None:
    """Returns the number of threads that XLA's CPU client needs, or None if its own choice is right.

    >>> thread_pool_size(2, "0.10.2")
    8
    >>> thread_pool_size(2, "0.12.0") is None
    True
    """
    if _release(jaxlib_version) in _FAULTY and cores < _ENOUGH_THREADS:
        return _ENOUGH_THREADS
    return None


def uses_shardy(jaxlib_version: str) -> bool:
    """Returns whether JAX's default partitioner works for programs of several devices.

    >>> uses_shardy("0.11.2"), uses_shardy("0.12.0")
    (False, True)
    """
    return _release(jaxlib_version) not in _SHARDY_CRASHES


def headless_backend(find_library: Callable[[str], str | None]) -> str | None:
    """Returns the backend for rendering without a display: `"egl"`, `"osmesa"`, or None if neither is installed.

    MuJoCo cannot even be imported if the backend's library is missing.

    >>> headless_backend({"OSMesa": "libOSMesa.so.8"}.get)
    'osmesa'
    """
    return next((library.lower() for library in ("EGL", "OSMesa") if find_library(library)), None)


def import_mujoco() -> None:
    """Imports MuJoCo, without its renderer if `MUJOCO_GL` names one that is unknown or whose library is missing.

    A plain import would fail then, even if only the physics is needed.
    """
    global rendering_fault
    chosen = os.environ.get("MUJOCO_GL")
    if not chosen or "mujoco" in sys.modules:
        importlib.import_module("mujoco")
        return
    os.environ["MUJOCO_GL"] = "disable"
    mujoco = importlib.import_module("mujoco")
    os.environ["MUJOCO_GL"] = chosen
    try:
        mujoco.GLContext = importlib.reload(mujoco.rendering.classic.gl_context).GLContext  # type: ignore[attr-defined]
    except Exception as error:  # those of PyOpenGL and ctypes are of many kinds
        rendering_fault = f"MUJOCO_GL={chosen} does not work: {error}"


@contextlib.contextmanager
def promotion() -> Iterator[None]:
    """Lets lines of a library promote ranks and types where the user's settings of JAX forbid it in all programs."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


def prepare() -> None:
    """Configures XLA, JAX and MuJoCo's renderer, and imports MJX without its notices of missing packages."""
    version = jaxlib.version.__version__
    os.environ["XLA_FLAGS"] = xla_flags(os.environ.get("XLA_FLAGS", ""), version)
    threads = thread_pool_size(os.cpu_count() or 1, version)
    if threads is not None:
        os.environ.setdefault("NPROC", str(threads))
    backend = headless_backend(ctypes.util.find_library)
    chosen = any(os.environ.get(name) for name in ("DISPLAY", "MUJOCO_GL"))
    if sys.platform == "linux" and not chosen and backend is not None:
        os.environ["MUJOCO_GL"] = backend
        if "mujoco" in sys.modules:  # it has read the variable already
            importlib.reload(importlib.import_module("mujoco.rendering.classic.gl_context"))
    import_mujoco()
    with contextlib.redirect_stdout(io.StringIO()):
        importlib.import_module("mujoco.mjx")
    # A program that calls C MuJoCo (`hgail_envs.engines.c`) can deadlock if a CPU dispatches it asynchronously.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    if not uses_shardy(version) and "JAX_USE_SHARDY_PARTITIONER" not in os.environ:
        jax.config.update("jax_use_shardy_partitioner", False)

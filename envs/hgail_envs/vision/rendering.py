"""Opens MuJoCo's renderer, which needs EGL or OSMesa where there is no display."""

import ctypes.util
import importlib
import os
import sys
import warnings
from collections.abc import Callable
from typing import Any

import mujoco

_BACKENDS = ("egl", "osmesa", "glfw")  # of MUJOCO_GL, on Linux


class RenderingError(RuntimeError):
    """Error of a machine on which MuJoCo cannot render; the message names a remedy."""


def open_renderer(model: mujoco.MjModel, height: int, width: int) -> "mujoco.Renderer":
    """Opens MuJoCo's renderer; a RenderingError says that it cannot render here."""
    try:
        _choose_backend()
        # Not `mujoco.Renderer`, which is missing, without a reason, where the backend could not be imported at first.
        renderer: Any = importlib.import_module("mujoco.rendering.classic.renderer")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW warns of a display that does not answer, then the renderer fails
            return renderer.Renderer(model, height, width)
    except Exception as error:  # each GL backend raises other exceptions
        display, chosen = os.environ.get("DISPLAY"), os.environ.get("MUJOCO_GL")
        if chosen and chosen.strip().lower() not in _BACKENDS:
            reason = f": MUJOCO_GL is {chosen!r}; choose from {', '.join(_BACKENDS)}"
        elif display and chosen is None:
            reason = f" on DISPLAY={display}; set MUJOCO_GL=egl or MUJOCO_GL=osmesa ({error})"
        else:
            reason = f" here, install EGL or OSMesa ({error})"
        raise RenderingError(f"MuJoCo cannot render{reason}") from error


def _choose_backend() -> None:
    """Sets `MUJOCO_GL` to EGL or OSMesa where neither it nor a display says with what to render.

    MuJoCo reads it when it is imported, and takes GLFW if it is not set, which needs a display.
    """
    if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("MUJOCO_GL"):
        return
    backend = headless_backend(ctypes.util.find_library)
    if backend is not None:
        os.environ["MUJOCO_GL"] = backend
        used: Any = importlib.import_module("mujoco.rendering.classic.gl_context")  # by MuJoCo's renderer
        used.GLContext = importlib.import_module(f"mujoco.{backend}").GLContext


def headless_backend(find_library: Callable[[str], str | None]) -> str | None:
    """Returns the backend for rendering without a display: `"egl"`, `"osmesa"`, or None if neither is installed.

    >>> headless_backend({"OSMesa": "libOSMesa.so.8"}.get)
    'osmesa'
    """
    return next((library.lower() for library in ("EGL", "OSMesa") if find_library(library)), None)

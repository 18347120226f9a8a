"""The physics engines, behind one interface: a state and a control in, the state after an action out.

`jax` and `warp` are MJX's two implementations, `c` is C MuJoCo on the host's cores. Tasks and learner do not depend on
the engine; a further one is a subclass of `Engine` and an entry of `ENGINES`.
"""

import importlib.util
from collections.abc import Callable

import jax
import mujoco
from jax._src import xla_bridge

from hgail_envs.engines.base import Control, Engine, EngineState
from hgail_envs.engines.c import CEngine
from hgail_envs.engines.mjx import MjxEngine, WarpEngine

ENGINES: dict[str, Callable[..., Engine]] = {"warp": WarpEngine, "c": CEngine, "jax": MjxEngine}
"""Engines by the value of `impl`."""


def resolve_impl(impl: str) -> str:
    """Returns the name of the engine that `impl` selects on this machine; starts JAX to ask for its device.

    `"auto"` is MJX-Warp on an NVIDIA GPU if warp-lang is installed, C MuJoCo on a CPU, and MJX-JAX elsewhere.

    Raises:
      ValueError: `impl` is neither an engine's name nor `"auto"`, or the engine is not available.
    """
    check_impl(impl)
    chosen = jax.config.jax_default_device  # type: ignore[attr-defined, unused-ignore]  # a device, a name or None
    platform = jax.default_backend() if chosen is None else getattr(chosen, "platform", chosen)
    has_warp = importlib.util.find_spec("warp") is not None and platform == "gpu"
    if impl == "warp" and not has_warp:
        raise ValueError("impl 'warp' needs warp-lang and an NVIDIA GPU; use 'jax', 'c' or 'auto'")
    if impl == "c" and platform != "cpu":
        raise ValueError("impl 'c' is for programs on a CPU; use 'auto', or set JAX_PLATFORMS=cpu")
    if impl != "auto":
        return impl
    if has_warp:
        return "warp"
    return "c" if platform == "cpu" else "jax"


def check_impl(impl: str) -> None:
    """Refuses a name that is neither an engine's nor `"auto"`, with a ValueError."""
    if impl != "auto" and impl not in ENGINES:
        raise ValueError(f"unknown impl {impl!r}; choose from auto, {', '.join(ENGINES)}")


def jax_has_started() -> bool:
    """Returns whether JAX has opened its devices; a process that is forked after that cannot use it."""
    # To 0.12.0 JAX has no public function that asks without opening them, see jax-ml/jax#23320.
    return xla_bridge.backends_are_initialized()


def make_engine(impl: str, model: mujoco.MjModel, period: float, substeps: int, worlds: int) -> Engine:
    """Makes the engine that `impl` selects, see `resolve_impl`; the other arguments are those of `Engine`."""
    return ENGINES[resolve_impl(impl)](model, period, substeps, worlds)


__all__ = [
    "ENGINES",
    "CEngine",
    "Control",
    "Engine",
    "EngineState",
    "check_impl",
    "jax_has_started",
    "make_engine",
    "resolve_impl",
]

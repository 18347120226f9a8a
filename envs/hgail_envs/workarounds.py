"""Works around faults of the installed JAX, MJX and Warp."""

import contextlib
import functools
import os
from collections.abc import Iterator
from typing import Any

import jax
import jaxlib.version

# Two faults of jaxlib's CPU backend up to 0.10; the releases from 0.11, which need Python 3.12, have neither:
# - the fusion emitters duplicate work along the arm's kinematic chain, so that a batched step of MJX-JAX runs hundreds
#   of times slower: reach with 256 environments in 10 s instead of 0.04 s (0.10.2, two cores). Releases without the
#   fault may abort on the flag as unknown;
# - a batched Cholesky factorisation waits, inside a thread of XLA's pool, for tasks that it puts into the same pool.
#   MJX has up to three at once, which deadlock on two cores. With more threads than that one is always free.
_FAULTY = [(0, minor) for minor in range(7, 11)]
_NO_FUSION_EMITTERS = "--xla_cpu_use_fusion_emitters=false"
_ENOUGH_THREADS = 8


def configure_xla() -> None:
    """Has XLA avoid two faults of the installed jaxlib that MJX-JAX meets on a CPU; call it before JAX starts.

    It sets `XLA_FLAGS` and `NPROC` for this process, where they do not say otherwise already. The command does it; in
    a program of your own only the engine `"jax"` on a CPU needs it.
    """
    major, minor = map(int, jaxlib.version.__version__.split(".")[:2])
    if (major, minor) not in _FAULTY:
        return
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_cpu_use_fusion_emitters" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_NO_FUSION_EMITTERS}".strip()
    if (os.cpu_count() or 1) < _ENOUGH_THREADS:
        os.environ.setdefault("NPROC", str(_ENOUGH_THREADS))


@contextlib.contextmanager
def promotion() -> Iterator[None]:
    """Lets lines of a library promote ranks and types where the user's settings of JAX forbid it in all programs."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


def keep_registered(stream: Any) -> None:
    """Has `warp.Stream` never unregister a stream of another library. JAX's last as long as the process.

    Warp (1.18 at least) wraps JAX's stream anew in each callback, and unregisters it with the wrapper. A function that
    a callback defines with `@warp.func` keeps the wrapper alive, in a cycle of frames, until Python collects garbage.
    If that is while a later callback records a graph on the same stream, recording fails: "unknown stream".
    """
    release = stream.__del__
    if hasattr(release, "__wrapped__"):
        return

    @functools.wraps(release)
    def release_own(self: Any) -> None:
        if self.owner:
            release(self)

    stream.__del__ = release_own

"""Works around faults of the installed JAX, MJX and Warp."""

import contextlib
import functools
import os
from collections.abc import Iterator
from typing import Any

import jax
import jaxlib.version

# Two faults of jaxlib's CPU backend up to 0.11.0, which 0.11.1 ends; Python 3.11 has no release after 0.10.2:
# - the fusion emitters duplicate work along the arm's kinematic chain (jax-ml/jax#33761), so that a batched step of
#   MJX-JAX runs hundreds of times slower: reach with 256 environments in 10 s instead of 0.04 s (0.10.2, two cores).
#   From 0.11.1 on XLA aborts on the flag, which it does not know any more;
# - a batched Cholesky factorisation waits, inside a thread of XLA's pool, for tasks that it puts into the same pool
#   (until jax-ml/jax@8599924). MJX has up to three at once, which deadlock on two cores. With more threads than that
#   one is always free.
_ENDED = (0, 11, 1)
_NO_FUSION_EMITTERS = "--xla_cpu_use_fusion_emitters=false"
_ENOUGH_THREADS = 8


def configure_xla() -> None:
    """Has XLA avoid two faults of the installed jaxlib that MJX-JAX meets on a CPU; call it before JAX starts.

    It sets `XLA_FLAGS` and `NPROC` for this process, where they do not say otherwise already. The command does it; in
    a program of your own only the engine `"jax"` on a CPU needs it.
    """
    if jaxlib.version.__version_info__ >= _ENDED:
        return
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_cpu_use_fusion_emitters" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_NO_FUSION_EMITTERS}".strip()
    if (os.cpu_count() or 1) < _ENOUGH_THREADS:
        os.environ.setdefault("NPROC", str(_ENOUGH_THREADS))


@contextlib.contextmanager
def promotion() -> Iterator[None]:
    """Lets lines of a library promote ranks and types where the user's settings of JAX forbid it in all programs.

    MJX 3.17.0, optax 0.2.8 and brax 0.14.2 have such lines; of none is there a newer release.
    """
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


def keep_registered(stream: Any) -> None:
    """Has `warp.Stream` never unregister a stream of another library. JAX's last as long as the process.

    Warp wraps JAX's stream anew in each callback, and unregisters it with the wrapper; no release ends it yet, 1.19.0
    is the newest. A function that a callback defines with `@warp.func` keeps the wrapper alive, in a cycle of frames,
    until Python collects garbage. If that is while a later callback records a graph on the same stream, recording
    fails: "unknown stream".
    """
    release = stream.__del__
    if hasattr(release, "__wrapped__"):
        return

    @functools.wraps(release)
    def release_own(self: Any) -> None:
        if self.owner:
            release(self)

    stream.__del__ = release_own

"""Works around faults of the installed JAX and MJX."""

import contextlib
import os
from collections.abc import Iterator

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
    version = jaxlib.version.__version__
    flags = xla_flags(os.environ.get("XLA_FLAGS", ""), version)
    if flags:
        os.environ["XLA_FLAGS"] = flags
    threads = thread_pool_size(os.cpu_count() or 1, version)
    if threads is not None:
        os.environ.setdefault("NPROC", str(threads))


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


def _release(version: str) -> tuple[int, int]:
    major, minor = version.split(".")[:2]
    return int(major), int(minor)


@contextlib.contextmanager
def promotion() -> Iterator[None]:
    """Lets lines of a library promote ranks and types where the user's settings of JAX forbid it in all programs."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield

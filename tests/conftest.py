import contextlib
import ctypes
import gc
import os
import sys
from pathlib import Path

import pytest

# The packages are imported within functions: the process that starts the workers runs no test, and does without them.

# One cache for all tests and for the processes that they start: the same program is compiled once.
ROOT = Path(__file__).parent.parent
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")  # the many small ones take long, too

_MUCH_MEMORY, _MORE_MEMORY = 1.2e9, 0.5e9  # bytes; freeing them takes a second
_QUICKLY = (
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    " --xla_cpu_parallel_codegen_split_count=1"
)


def pytest_configure(config):
    """Has XLA compile quickly, which is most of what these tests do; not the slow ones, which compute."""
    if not hasattr(config, "workerinput") and getattr(config.option, "numprocesses", None):
        return  # of the process that starts the workers
    from hgail_envs.workarounds import configure_xla

    configure_xla()  # as the command does, before JAX starts
    flags = os.environ.get("XLA_FLAGS", "")
    if config.option.markexpr == "not slow" and "optimization_level" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_QUICKLY}".strip()


def _resident():
    """Returns the bytes that this process has in memory; infinity where Linux does not say."""
    with contextlib.suppress(OSError):
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return float("inf")


def pytest_collection_finish():
    """Has the collector pass over what was imported; JAX makes so many objects that it would search it all the time."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


_memory_kept = 0.0


@pytest.fixture(scope="module", autouse=True)
def programs_of_a_few_files():
    """Frees compiled programs after a file's tests, once they fill much memory; the next file has others."""
    global _memory_kept
    yield
    if "jax" in sys.modules and _resident() > max(_MUCH_MEMORY, _memory_kept + _MORE_MEMORY):
        sys.modules["jax"].clear_caches()
        gc.collect()
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)  # else glibc keeps what was freed
        _memory_kept = _resident()


@pytest.fixture(scope="session")
def shipped_policy():
    """The policy for reach that comes with the package."""
    from hgail_envs.scenes import assets_directory

    return assets_directory() / "policies" / "reach.npz"


@pytest.fixture(scope="session")
def grasp_policy():
    """The policy for grasp that comes with the package."""
    from hgail_envs.scenes import assets_directory

    return assets_directory() / "policies" / "grasp.npz"


@pytest.fixture(scope="session")
def tracking_policy():
    """A policy of grasp that is given where the cube is at each step: it goes there, and opens the hand."""
    import numpy as np

    from hgail_jax.policy import MeanPolicy

    weights, bias = np.zeros((15, 4), np.float32), np.array([0, 0, 0, 1], np.float32)
    weights[[8, 9, 10], [0, 1, 2]] = 20.0
    observed = np.zeros(15, np.float32), np.ones(15, np.float32)
    return MeanPolicy("grasp", 4, *observed, ((weights, bias),), task_options={"cube": "tracked"})


@pytest.fixture(scope="session")
def forks(tmp_path_factory):
    """Runs scripts in processes of their own, without the seconds that importing the package takes."""
    from tests.forks import Forks

    started = Forks(tmp_path_factory.mktemp("forks"))
    yield started
    started.close()


@pytest.fixture(scope="session")
def rendering():
    """Skips where MuJoCo cannot render."""
    from hgail_envs.robots.fetch import Fetch
    from hgail_envs.vision.rendering import open_renderer

    try:
        open_renderer(Fetch("reach").model, 8, 8).close()
    except RuntimeError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def step_of_two():
    """The compiled step of two states side by side, tiny ones of point."""
    import hgail_envs
    from hgail_jax import Hyperparameters, phase_table
    from hgail_jax.seeds import compile_train_step, init_sweep, seed_keys
    from tests.support import TINY

    env = hgail_envs.make("point")
    states = init_sweep(env, TINY, [Hyperparameters()] * 2, seed_keys(0, 1))
    return compile_train_step(env, TINY, states, phase_table(TINY)[0])

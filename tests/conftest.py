import os
from pathlib import Path

import jax
import pytest

import envs  # noqa: F401  (sets what XLA reads before JAX starts)

# One cache for all tests and runs of the suite: the same program is compiled once.
_CACHE = Path(__file__).parent.parent / ".cache" / "jax"
jax.config.update("jax_compilation_cache_dir", os.environ.get("JAX_COMPILATION_CACHE_DIR", str(_CACHE)))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@pytest.fixture(scope="session")
def shipped_policy():
    """A policy that `python experiments/run.py --seeds 8` trained."""
    return Path(__file__).parent.parent / "experiments" / "results" / "reach-hgail" / "policies" / "seed-0.npz"

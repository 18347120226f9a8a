"""A trained policy as a StableHLO program, for runtimes that are not Python."""

from pathlib import Path

import jax
import jax.export
import jax.numpy as jnp

from hgail_jax.io.files import replace_file
from hgail_jax.io.policy import MeanPolicy


def export_policy(path: Path | str, policy: MeanPolicy) -> None:
    """Writes the mean action as a portable StableHLO artifact: a function `main` with the weights in it.

    It maps one observation, float32 `[observation_size]`, to one action, `[action_size]`, and calls nothing but
    StableHLO's own operations, so that any compiler of StableHLO runs it.
    """
    observation = jax.ShapeDtypeStruct((policy.observation_size,), jnp.float32)
    exported = jax.export.export(jax.jit(lambda seen: policy(seen, xp=jnp)), platforms=("cpu",))(observation)
    with replace_file(path, "wb") as file:
        file.write(exported.mlir_module_serialized)

"""Works out how fast stepping could be: bytes against the memory's bandwidth."""

import jax
from mujoco import mjx
from speed import Size

from envs.fetch import settle


def measure_floor(size: Size, bandwidth: float) -> dict[str, float]:
    """Returns bytes and operations of a physics step, and the env steps per second that the bytes alone allow.

    State bytes are positions, velocities and the solver's start, read and written once in each step: no engine moves
    less. Engine bytes are all that MJX-JAX holds of an environment, likewise; operations are its own, the loop of the
    solver run once.

    Args:
      size: what is stepped.
      bandwidth: bytes per second, read and written.

    """
    model, settled = size.env.model, settle(size.env.model)
    engine, data = mjx.put_model(model, impl="jax"), mjx.put_data(model, settled, impl="jax")
    cost = jax.jit(mjx.step).lower(engine, data).cost_analysis() or {}
    state_bytes = 2 * 4 * (model.nq + 2 * model.nv)
    return {
        "memory_bytes_per_second": bandwidth,
        "state_bytes_per_substep": state_bytes,
        "engine_bytes_per_substep": 2 * sum(leaf.nbytes for leaf in jax.tree.leaves(data)),
        "operations_per_substep": float(cost.get("flops", 0.0)),
        "state_floor_env_steps_per_second": bandwidth / (state_bytes * size.substeps),
    }

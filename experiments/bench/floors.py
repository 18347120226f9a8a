"""Bounds the speed of stepping by the bytes and operations of a physics step."""

import math

import jax
from mujoco import mjx

from experiments.bench.timing import arithmetic_rate, memory_bandwidth
from experiments.bench.workload import Workload
from hgail_envs.fetch.arm import settle


def measure_floors(workload: Workload) -> dict[str, float]:
    """Returns bytes and operations of a physics step, and the env steps per second that either allows on the device.

    State bytes are positions, velocities and the solver's start, read and written once in each step, as in an engine
    that keeps nothing on the chip between steps. Engine bytes are the whole `mjx.Data` of an environment, likewise.
    Operations are MJX-JAX's own with one iteration of the solver: a scale for other engines, not a bound.
    """
    model, host = workload.env.model, jax.devices("cpu")[0]
    mjx_model = mjx.put_model(model, device=host, impl="jax")
    data = mjx.put_data(model, settle(model, workload.env.base_x, workload.env.start_height), device=host, impl="jax")
    with jax.default_device(host):
        operations = (jax.jit(mjx.step).lower(mjx_model, data).cost_analysis() or {}).get("flops", math.nan)
    state_bytes = 2 * 4 * (model.nq + 2 * model.nv)
    bandwidth, rate = memory_bandwidth(workload.quick), arithmetic_rate(workload.quick)
    return {
        "memory_bytes_per_second": bandwidth,
        "operations_per_second": rate,
        "state_bytes_per_substep": state_bytes,
        "engine_bytes_per_substep": 2 * sum(leaf.nbytes for leaf in jax.tree.leaves(data)),
        "operations_per_substep": operations,
        "state_floor_env_steps_per_second": bandwidth / (state_bytes * workload.substeps),
        "operations_floor_env_steps_per_second": rate / (operations * workload.substeps),
    }

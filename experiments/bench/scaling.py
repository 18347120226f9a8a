"""Measures the scaling with seeds and with devices."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax

from experiments.bench.training import Training
from experiments.bench.workload import Workload, seconds_per_call
from hgail_jax.devices.sharding import make_mesh


def measure_seeds(workload: Workload, counts: tuple[int, ...]) -> Iterator[dict[str, Any]]:
    """Times a round for each number of seeds side by side on one device, the first number 1; yields rows."""
    alone = None
    for seeds in counts:
        row = _measure(workload, seeds, devices=1)
        alone = alone or row["round_seconds"]
        yield row | {"cost_in_rounds_of_one_seed": row["round_seconds"] / alone}


def measure_devices(workload: Workload) -> Iterator[dict[str, Any]]:
    """Times seeds, then environments, on one device and on all devices; yields rows.

    A weak speed-up compares with one device that has one device's part of the work, a strong one with all of it.

    Raises:
      ValueError: there is only one device.
    """
    devices = jax.device_count()
    if devices == 1:
        raise ValueError("there is one device; the section devices compares several with one")
    part = _measure(workload, 1, devices=1)
    yield part
    wide = dataclasses.replace(workload, num_envs=workload.num_envs * devices)
    for measured, seeds in ((workload, devices), (wide, 1)):
        all_on_one = _measure(measured, seeds, devices=1)
        yield all_on_one
        spread_out = _measure(measured, seeds, devices)
        yield spread_out | {
            f"{kind}_speed_up": spread_out["train_env_steps_per_second"] / base["train_env_steps_per_second"]
            for kind, base in (("weak", part), ("strong", all_on_one))
        }


def _measure(workload: Workload, seeds: int, devices: int) -> dict[str, Any]:
    """Times a round of `seeds`, each in `workload.num_envs` environments, on `devices`."""
    mesh = make_mesh(seeds, workload.num_envs, jax.devices()[:devices])
    workload = dataclasses.replace(workload, worlds=seeds * workload.num_envs // devices)
    training = Training(workload, seeds, mesh)
    phases = training.updates()
    seconds = seconds_per_call(training.call(*phases))
    return {
        "task": workload.task,
        "impl": workload.env.impl,
        "substeps": workload.substeps,
        "seeds": seeds,
        "num_envs_per_seed": workload.num_envs,
        "devices": devices,
        "round_seconds": seconds,
        "train_env_steps_per_second": seeds * len(phases) * workload.env_steps / seconds,
        "train_compile_seconds": training.compile_seconds,
    }

"""Measures what more seeds, and more devices, cost and bring."""

import dataclasses
from collections.abc import Iterator

import jax

from experiments.bench.shares import Training
from experiments.bench.speed import Size
from hgail_jax.distributed.sharding import make_mesh


def _measure(size: Size, seeds: int, devices: int) -> dict:
    """Times a round of so many seeds, each in `size.num_envs` environments, on so many devices."""
    mesh = make_mesh(seeds, size.num_envs, jax.devices()[:devices])
    size = dataclasses.replace(size, worlds=seeds * size.num_envs // devices)
    training = Training(size, seeds, mesh)
    phases = training.updates()
    seconds = training.seconds(*phases)
    return {
        "task": size.task,
        "impl": size.env.impl,
        "substeps": size.substeps,
        "seeds": seeds,
        "num_envs_per_seed": size.num_envs,
        "devices": devices,
        "round_seconds": seconds,
        "train_env_steps_per_second": seeds * len(phases) * size.env_steps / seconds,
        "train_compile_seconds": training.compile_seconds,
    }


def measure_seeds(size: Size, counts: tuple[int, ...]) -> Iterator[dict]:
    """Times a round for each number of seeds side by side on one device, the first of them 1; yields rows."""
    alone = None
    for seeds in counts:
        row = _measure(size, seeds, 1)
        alone = alone or row["round_seconds"]
        yield row | {"cost_in_rounds_of_one_seed": row["round_seconds"] / alone}


def measure_devices(size: Size, devices: int) -> Iterator[dict]:
    """Times seeds and environments on one device and on `devices`; yields rows.

    A weak speed-up compares with one device that has its share of the work, a strong one with one that has all of it.

    Raises:
      ValueError: there is one device alone.

    """
    if devices == 1:
        raise ValueError("there is one device; the section devices compares several with one")
    wide = dataclasses.replace(size, num_envs=size.num_envs * devices)
    share = _measure(size, 1, 1)
    yield share
    for measured, seeds in ((wide, 1), (size, devices)):
        spread_out, all_on_one = _measure(measured, seeds, devices), _measure(measured, seeds, 1)
        yield all_on_one
        yield spread_out | {
            f"{kind}_speed_up": spread_out["train_env_steps_per_second"] / base["train_env_steps_per_second"]
            for kind, base in (("weak", share), ("strong", all_on_one))
        }

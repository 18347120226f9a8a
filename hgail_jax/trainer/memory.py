"""Estimates the memory that a run takes, and refuses one that cannot fit, before anything is compiled."""

import dataclasses
import functools
import os
from collections.abc import Callable
from pathlib import Path

import jax

from hgail_jax.trainer.run import Run
from hgail_jax.validation import MOST
from hgail_jax.wording import counted

# Measured as the temporaries of compiled training steps on a CPU (point, reach and grasp, 1 to 64 seeds, 16 to 16,384
# environments): the estimate was 9 % too low to 3 % too high. Relabelling weighs all steps of an episode against all.
_RELABELLING = 6  # numbers per pair of steps
_SAMPLE = 4  # copies of an observation and action
_DRAW = 90  # bytes per sample of a minibatch, all minibatches being drawn at once
_LEARNER = 3  # copies: the state, the next one, and what a checkpoint copies
_STATES = 2  # copies of the physics state


def check_memory(run: Run) -> None:
    """Refuses a run that is too large for the memory which is free, of the device, or of the host on a CPU.

    Raises:
      ValueError: it is; the message says what fits.

    """
    free = free_memory(run.mesh.devices.flat[0])
    needed = estimate_memory(run)
    if free is None or needed <= free:
        return
    smaller = [
        f"{option} {count}"
        for option, name in (("--num-envs", "num_envs"), ("--seeds", "seeds"))
        if (count := _most(functools.partial(_fits, run, name, free)))
    ]
    raise ValueError(
        f"{counted(run.seeds, 'seed')} of {counted(run.config.num_envs, 'environment')} would need about"
        f" {_gigabytes(needed)} of memory on a device and {_gigabytes(free)} are free;"
        f" at most {' or '.join(smaller) or 'a smaller task'} would fit"
    )


def estimate_memory(run: Run) -> float:
    """Returns about how many bytes a run takes on a device, the physics engine's own buffers not counted.

    A training step holds either the minibatches that it draws or the samples of a roll-out, whichever is more.
    """
    env, config = run.env, run.config
    rows = run.seeds / run.mesh.size
    steps, numbers = env.episode_length, env.observation_size + env.action_size
    samples = config.num_envs * steps * 4 * (_RELABELLING * (steps + 1) + _SAMPLE * numbers)
    draws = max(
        config.discriminator_minibatches * config.discriminator_batch,
        config.pretrain * config.pretrain_discriminator_minibatches * config.discriminator_batch,
        config.pretrain * config.pretrain_policy_minibatches * config.pretrain_policy_batch,
    )
    one_seed = dataclasses.replace(run, seeds=1).program()
    learner = _bytes(jax.eval_shape(one_seed.init))
    physics = config.num_envs * _bytes(jax.eval_shape(env.reset_physics, jax.eval_shape(lambda: jax.random.key(0))))
    return rows * (max(samples, _DRAW * draws) + _LEARNER * learner + _STATES * physics)


def free_memory(device: jax.Device) -> int | None:
    """Returns the bytes that are free on a device, on a CPU those of the host; None where nobody can tell."""
    if device.platform == "cpu":
        return _free_on_host()
    stats = device.memory_stats() or {}
    return stats["bytes_limit"] - stats["bytes_in_use"] if {"bytes_limit", "bytes_in_use"} <= set(stats) else None


def _free_on_host() -> int | None:
    """Returns the bytes that the system, or the container that this process runs in, has to give."""
    found = []
    try:
        entries = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        found.append(1024 * int(entries["MemAvailable"].split()[0]))
    except (OSError, KeyError, ValueError):  # no Linux
        found.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    try:
        group = Path("/sys/fs/cgroup")
        found.append(int((group / "memory.max").read_text()) - int((group / "memory.current").read_text()))
    except (OSError, ValueError):  # no limit
        pass
    return min(found)


def _fits(run: Run, name: str, free: int, value: int) -> bool:
    return estimate_memory(_resize(run, name, value)) <= free


def _resize(run: Run, name: str, value: int) -> Run:
    if name == "seeds":
        return dataclasses.replace(run, seeds=value)
    return dataclasses.replace(run, config=dataclasses.replace(run.config, num_envs=value))


def _most(fits: Callable[[int], bool]) -> int:
    """Returns the largest count that fits, 0 if none does, given that all smaller ones do."""
    low, high = 0, MOST
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low


def _bytes(shapes: object) -> int:
    leaves = jax.tree.leaves(shapes)
    return sum(
        leaf.size * (8 if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf.dtype.itemsize)
        for leaf in leaves
    )


def _gigabytes(count: float) -> str:
    return f"{count / 1e9:,.1f} GB"

"""Times calls on a device."""

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax

from hgail_jax.devices.compilation import compile_program

_ENOUGH_SECONDS = 4.0
_FEWEST_CALLS = 5
_MOST_CALLS = 50


def compile_timed(function: Callable, *arguments: Any) -> tuple[Callable, float]:
    """Returns `function` compiled for `arguments` with the options of training, and the seconds of the compilation."""
    started = time.perf_counter()
    compiled = compile_program(jax.jit(function), *arguments)
    return compiled, time.perf_counter() - started


def seconds_per_call(call: Callable[[], Any]) -> float:
    """Returns the median time of a call, after one to warm up."""
    return seconds_side_by_side({"call": call})["call"]


def seconds_side_by_side(calls: Mapping[str, Callable[[], Any]]) -> dict[str, float]:
    """Returns the median time of each call, timed in turn.

    A machine that is slower for a while then slows all of them, which leaves their ratios unchanged.
    """
    for call in calls.values():
        jax.block_until_ready(call())
    taken: dict[str, list[float]] = {name: [] for name in calls}
    started = time.perf_counter()
    for turn in range(_MOST_CALLS):
        if turn >= _FEWEST_CALLS and time.perf_counter() - started > _ENOUGH_SECONDS * len(calls):
            break
        for name, call in calls.items():
            taken[name].append(_seconds(call))
    return {name: statistics.median(seconds) for name, seconds in taken.items()}


def _seconds(call: Callable[[], Any]) -> float:
    started = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - started

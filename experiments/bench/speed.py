"""Rows of a workload: its speed of stepping, roll-outs and training, and the fractions of a round's time."""

import functools
from collections.abc import Callable, Collection, Mapping
from typing import Any, Protocol

import jax

from experiments.bench.training import (
    Learning,
    PPOPhases,
    RollingOut,
    TD3Phases,
    Training,
    ppo_fractions,
    td3_fractions,
)
from experiments.bench.workload import Workload, compile_timed, seconds_side_by_side
from hgail_envs import GoalEnv, State
from hgail_jax.learners import TD3

COLUMNS = ("physics", "rollout", "train", "shares")
"""Groups of columns to measure; `shares`, the fractions of a round's time, need and include the others."""


class _Part(Protocol):
    """Calls to be timed, and the columns that their times give."""

    calls: dict[str, Callable[[], Any]]

    def row(self, seconds: Mapping[str, float]) -> dict[str, float]: ...


class Stepping:
    """An episode of random actions in one compiled program, to be timed.

    Args:
      workload: to step.
    """

    def __init__(self, workload: Workload) -> None:
        self._env_steps = workload.env_steps
        start, actions = workload.reset(), workload.actions()
        step, self._compile_seconds = compile_timed(functools.partial(_step, workload.env), start, actions)
        self.calls: dict[str, Callable[[], Any]] = {"raw": functools.partial(step, start, actions)}
        """The call by its name."""

    def row(self, seconds: Mapping[str, float]) -> dict[str, float]:
        """Returns the row's columns from the seconds of each call."""
        return {
            "raw_env_steps_per_second": self._env_steps / seconds["raw"],
            "raw_compile_seconds": self._compile_seconds,
        }


def _step(env: GoalEnv, states: State, actions: jax.Array) -> State:
    """Steps `N` environments by actions `[T, N, action_size]`; returns the last states, `[N, ...]`."""
    return jax.lax.scan(lambda states, action: (jax.vmap(env.step)(states, action), None), states, actions)[0]


def speed_row(workload: Workload, columns: Collection[str]) -> dict[str, Any]:
    """Measures the named groups of `COLUMNS`."""
    wanted = set(COLUMNS if "shares" in columns else columns)
    row: dict[str, Any] = {
        "task": workload.task,
        "impl": workload.env.impl,
        "num_envs": workload.num_envs,
        "substeps": workload.substeps,
        "what": ", ".join(name for name in COLUMNS if name in wanted),
    }
    off_policy = isinstance(workload.preset.config.learner, TD3)
    parts: list[_Part] = []
    if "physics" in wanted:
        parts.append(Stepping(workload))
    if "rollout" in wanted:
        parts.append(RollingOut(workload))
    if "train" in wanted:
        training = Training(workload)
        parts.append(Learning(training))
        if "shares" in wanted:
            parts.append(TD3Phases(training) if off_policy else PPOPhases(training))
    seconds = seconds_side_by_side({name: call for part in parts for name, call in part.calls.items()})
    row |= {name: value for part in parts for name, value in part.row(seconds).items()}
    if {"physics", "train"} <= wanted:
        row["train_to_raw"] = row["train_env_steps_per_second"] / row["raw_env_steps_per_second"]
    if "shares" in wanted:
        row |= (td3_fractions if off_policy else ppo_fractions)(workload, row)
    return row

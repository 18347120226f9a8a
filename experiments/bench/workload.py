"""Workload of a measurement: a task on an engine, in a number of environments; and times calls on a device."""

import dataclasses
import functools
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax

import hgail_envs
from experiments import FEW_UPDATES
from hgail_envs.tasks.base import ArmEnv
from hgail_jax.devices.compilation import compile_program
from hgail_jax.settings.defaults import platform_name, task_preset
from hgail_jax.settings.presets import Preset
from hgail_jax.trainer.train_options import TrainOptions, plan

_QUICK_EPISODE = 4  # steps
_QUICK: dict[str, dict[str, Any]] = {
    "ppo": FEW_UPDATES,
    "td3": {"rollouts": 2, "updates": 2, "batch": 16, "buffer_episodes": 64, "discriminator_batch": 16},
}


def default_preset(task: str) -> Preset:
    """Returns the settings that `hgail train` has for a task on this platform, with the task's default learner."""
    run = plan(TrainOptions(task=task, seeds=1), platform_name())
    found = task_preset(hgail_envs.find_class(task), platform_name(), learner=run.config.learner.name)
    return dataclasses.replace(found, config=run.config, hyperparameters=run.hyperparameters)


def default_substeps(task: str, platform: str) -> int:
    """Returns the physics steps per action that a Fetch task is trained with on `"cpu"` or `"gpu"`."""
    return task_preset(hgail_envs.find_class(task), platform).task_options["substeps"]


@dataclasses.dataclass(frozen=True)
class Workload:
    """A Fetch task in `N = num_envs` environments, for episodes of `T` steps."""

    task: str
    impl: str
    """Physics engine, see `hgail_envs.engines.resolve_impl`."""
    num_envs: int
    substeps: int
    """Physics steps per action."""
    quick: bool = False
    """Takes short episodes and few updates to show that everything runs."""
    worlds: int | None = None
    """Environments that a device steps at once; None is `num_envs`."""

    @functools.cached_property
    def env(self) -> ArmEnv:
        """The task."""
        physics = {"impl": self.impl, "substeps": self.substeps, "worlds": self.worlds or self.num_envs}
        env = hgail_envs.make(self.task, **{**self.preset.task_options, **physics})
        assert isinstance(env, ArmEnv)
        if self.quick:
            env.episode_length = _QUICK_EPISODE
        return env

    @property
    def env_steps(self) -> int:
        """Environment steps of one episode in every environment."""
        return self.num_envs * self.env.episode_length

    @functools.cached_property
    def preset(self) -> Preset:
        """The task's default preset, in roll-outs of `num_envs` episodes."""
        preset = default_preset(self.task)
        quick = _QUICK[preset.config.learner.name] if self.quick else {}
        return dataclasses.replace(preset, config=preset.config.replace(num_envs=self.num_envs, **quick))

    def actions(self) -> jax.Array:
        """Returns random actions, `[T, N, action_size]`."""
        shape = (self.env.episode_length, self.num_envs, self.env.action_size)
        return jax.random.uniform(jax.random.key(1), shape, minval=-1.0, maxval=1.0)

    def reset(self) -> hgail_envs.State:
        """Returns the states at the start of an episode, `[N, ...]`."""
        return jax.jit(jax.vmap(self.env.reset))(jax.random.split(jax.random.key(0), self.num_envs))


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

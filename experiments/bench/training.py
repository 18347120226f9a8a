"""Roll-outs and training, and the fractions of a round in physics, policy, relabelling and updates."""

import functools
import time
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from experiments.bench.workload import Workload, compile_timed
from hgail_jax.devices.sharding import shard
from hgail_jax.learner import LEARNING
from hgail_jax.learners import PPO
from hgail_jax.rollout import Trajectory, rollout
from hgail_jax.samples import relabelled_samples
from hgail_jax.seeds import SeedsStep, compile_train_step, init_seeds, seed_keys
from hgail_jax.state import TrainState
from hgail_jax.train import Phase, init_state, make_policy, phase_table


class Training:
    """Seeds in training, to be timed phase by phase; off-policy with a full replay buffer.

    Args:
      workload: of each seed.
      seeds: side by side.
      mesh: of devices; None is a single one.
    """

    def __init__(self, workload: Workload, seeds: int = 1, mesh: Mesh | None = None) -> None:
        self.workload, self.seeds = workload, seeds
        self.config = workload.preset.config
        self._row = phase_table(self.config)[0]
        states = init_seeds(workload.env, self.config, workload.preset.hyperparameters, seed_keys(0, seeds))
        if states.buffer is not None:
            added = jnp.full_like(states.buffer.added, states.buffer.valid.shape[-1])
            states = states.replace(buffer=states.buffer.replace(added=added))
        self.states: TrainState = states if mesh is None else shard(states, mesh)
        """Untrained, `[seeds, ...]`."""

        started = time.perf_counter()
        self._step: SeedsStep = compile_train_step(workload.env, self.config, states, self._row, mesh)
        self.compile_seconds = time.perf_counter() - started

    def call(self, *phases: Phase) -> Callable[[], Any]:
        """Returns a function that trains a round of these phases with each call, and skips the rest of the round."""
        row = np.full_like(self._row, Phase.SKIP)
        row[: len(phases)] = phases
        states = jax.tree.map(jnp.copy, self.states)  # a copy, as the step donates its argument

        def call() -> Any:
            nonlocal states
            states, metrics = self._step(states, row)
            return metrics

        return call

    def updates(self) -> list[Phase]:
        """Returns the phases of a round that learn."""
        return [Phase(phase) for phase in phase_table(self.config)[-1] if phase in LEARNING]


class RollingOut:
    """A roll-out of an untrained policy, and with PPO the relabelling of its samples, to be timed.

    Args:
      workload: to roll out.
    """

    def __init__(self, workload: Workload) -> None:
        env, preset = workload.env, workload.preset
        config, hyperparameters = preset.config, preset.hyperparameters
        self._env_steps = workload.env_steps
        state = init_state(env, config, hyperparameters, jax.random.key(0))
        rollout_rng, relabel_rng = jax.random.split(jax.random.key(1))

        def roll_out(state: TrainState, rng: jax.Array) -> Trajectory:
            return rollout(env, make_policy(env, config, state, noise=1.0), rng, config.num_envs)

        compiled, _ = compile_timed(roll_out, state, rollout_rng)
        trajectory = compiled(state, rollout_rng)
        self.calls: dict[str, Callable[[], Any]] = {"rollout": lambda: compiled(state, rollout_rng)}
        """Calls by name, each an episode in every environment."""
        if isinstance(config.learner, PPO):  # off-policy goals are drawn anew with each sample
            relabelling = functools.partial(relabelled_samples, env, hyperparameters)
            relabel, _ = compile_timed(relabelling, trajectory, relabel_rng)
            self.calls["relabel"] = lambda: relabel(trajectory, relabel_rng)

    def row(self, seconds: Mapping[str, float]) -> dict[str, float]:
        """Returns the row's columns from the seconds of each call."""
        rate = {"rollout_env_steps_per_second": self._env_steps / seconds["rollout"]}
        return rate | ({"relabel_seconds": seconds["relabel"]} if "relabel" in self.calls else {})


class Learning:
    """The phases of a default round that learn, without pre-training, to be timed.

    Args:
      training: of one seed.
    """

    def __init__(self, training: Training) -> None:
        phases = training.updates()
        self._env_steps, self._compile_seconds = len(phases) * training.workload.env_steps, training.compile_seconds
        self.calls = {"train": training.call(*phases)}
        """The call by its name."""

    def row(self, seconds: Mapping[str, float]) -> dict[str, float]:
        """Returns the row's columns from the seconds of each call."""
        return {
            "train_env_steps_per_second": self._env_steps / seconds["train"],
            "train_compile_seconds": self._compile_seconds,
        }


class _Phases:
    """Phases of a round, each alone, to be timed.

    Args:
      training: of one seed.
    """

    _PHASES: ClassVar[dict[str, Phase]]
    """Phases by their names in the row."""

    def __init__(self, training: Training) -> None:
        self.calls = {name: training.call(phase) for name, phase in self._PHASES.items()}
        """Calls by name."""

    def row(self, seconds: Mapping[str, float]) -> dict[str, float]:
        """Returns the row's columns from the seconds of each call."""
        return {f"{name}_seconds": seconds[name] for name in self.calls}


class PPOPhases(_Phases):
    """PPO's phases, see `_Phases`."""

    _PHASES: ClassVar[dict[str, Phase]] = {
        "ppo_phase": Phase.POLICY,
        "discriminator_phase": Phase.DISCRIMINATOR,
        "pretrain_phase": Phase.PRETRAIN,
        "evaluation_phase": Phase.EVALUATE,
    }


class TD3Phases(_Phases):
    """TD3's phases, of which pre-training only fills the buffer, see `_Phases`."""

    _PHASES: ClassVar[dict[str, Phase]] = {"update_phase": Phase.POLICY, "rollout_phase": Phase.PRETRAIN}


def ppo_fractions(workload: Workload, row: dict[str, Any]) -> dict[str, float]:
    """Returns the fractions of the time of a round of PPO, which add up to 1, from a row's measurements.

    A phase is a roll-out, the relabelling of its samples if it needs them, and an update, which is the rest.
    """
    sizes: Any = workload.preset.config.learner
    policy, discriminator = sizes.policy_phases, sizes.discriminator_phases
    stepping = workload.env_steps / row["raw_env_steps_per_second"]
    rolling_out = workload.env_steps / row["rollout_env_steps_per_second"]
    relabelling = row["relabel_seconds"]
    policy_relabelling = relabelling if sizes.bc_batch else 0.0  # without behaviour cloning PPO needs no expert samples
    seconds = {
        "physics": (policy + discriminator) * stepping,
        "policy_and_bookkeeping": (policy + discriminator) * (rolling_out - stepping),
        "relabelling": policy * policy_relabelling + discriminator * relabelling,
        "ppo": policy * (row["ppo_phase_seconds"] - rolling_out - policy_relabelling),
        "discriminator": discriminator * (row["discriminator_phase_seconds"] - rolling_out - relabelling),
    }
    return _fractions(seconds)


def td3_fractions(workload: Workload, row: dict[str, Any]) -> dict[str, float]:
    """Returns the fractions of the time of TD3's update phase, which add up to 1, from a row's measurements."""
    stepping = workload.env_steps / row["raw_env_steps_per_second"]
    seconds = {
        "physics": stepping,
        "policy_and_bookkeeping": row["rollout_phase_seconds"] - stepping,
        "updates": row["update_phase_seconds"] - row["rollout_phase_seconds"],
    }
    return _fractions(seconds)


def _fractions(seconds: Mapping[str, float]) -> dict[str, float]:
    return {f"share_{name}": taken / sum(seconds.values()) for name, taken in seconds.items()}

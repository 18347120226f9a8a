"""Measures roll-outs and training, and which share of a round is physics, the policy, relabelling or an update."""

import functools
import time
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from experiments.bench.timing import compile_timed, seconds_per_call
from experiments.bench.workload import Workload
from hgail_jax.distributed.seeds import SeedsStep, compile_train_step, init_seeds, seed_keys
from hgail_jax.distributed.sharding import shard
from hgail_jax.rollout import Trajectory, rollout
from hgail_jax.samples import relabelled_samples
from hgail_jax.state import TrainState, init_state
from hgail_jax.train import Phase, schedule
from hgail_jax.updates import make_policy


class Training:
    """Seeds in training, to be timed phase by phase.

    Args:
      workload: what each seed trains on.
      seeds: side by side.
      mesh: the devices; None is one.

    """

    def __init__(self, workload: Workload, seeds: int = 1, mesh: Mesh | None = None) -> None:
        preset = workload.preset()
        self.config = preset.config
        self._row = schedule(self.config)[0]
        states = init_seeds(workload.env, self.config, preset.hyperparameters, seed_keys(0, seeds))
        self._states = states if mesh is None else shard(states, mesh)

        started = time.perf_counter()
        self._step: SeedsStep = compile_train_step(workload.env, self.config, states, self._row, mesh)
        self.compile_seconds = time.perf_counter() - started

    def seconds(self, *phases: Phase) -> float:
        """Returns the seconds that a round of these phases takes; the rest of its row is skipped."""
        row = np.full_like(self._row, Phase.SKIP)
        row[: len(phases)] = phases

        def call() -> Any:
            self._states, metrics = self._step(self._states, row)
            return metrics

        return seconds_per_call(call)

    def updates(self) -> list[Phase]:
        """Returns the phases of a round that learn."""
        return [Phase.POLICY] * self.config.policy_phases + [Phase.DISCRIMINATOR] * self.config.discriminator_phases


def measure_rollout(workload: Workload) -> dict[str, float]:
    """Times a roll-out of an untrained policy, and the relabelling of its samples."""
    env, preset = workload.env, workload.preset()
    config, hyperparameters = preset.config, preset.hyperparameters
    state = init_state(env, config, hyperparameters, jax.random.key(0))
    rollout_rng, relabel_rng = jax.random.split(jax.random.key(1))

    def roll_out(state: TrainState, rng: jax.Array) -> Trajectory:
        return rollout(env, make_policy(env, config, state, noise=1.0), rng, config.num_envs)

    compiled, _ = compile_timed(roll_out, state, rollout_rng)
    seconds = seconds_per_call(lambda: compiled(state, rollout_rng))
    trajectory = compiled(state, rollout_rng)
    relabel, _ = compile_timed(functools.partial(relabelled_samples, env, hyperparameters), trajectory, relabel_rng)
    return {
        "rollout_env_steps_per_second": workload.env_steps / seconds,
        "relabel_seconds": seconds_per_call(lambda: relabel(trajectory, relabel_rng)),
    }


def measure_training(workload: Workload, each_phase: bool) -> dict[str, float]:
    """Times the phases of a round that learn, PPO and discriminator as often as by default.

    Where `each_phase`, each kind of phase alone as well.
    """
    training = Training(workload)
    phases = training.updates()
    measured = {
        "train_env_steps_per_second": len(phases) * workload.env_steps / training.seconds(*phases),
        "train_compile_seconds": training.compile_seconds,
    }
    if each_phase:
        measured |= {
            "ppo_phase_seconds": training.seconds(Phase.POLICY),
            "discriminator_phase_seconds": training.seconds(Phase.DISCRIMINATOR),
            "pretrain_phase_seconds": training.seconds(Phase.PRETRAIN),
            "evaluation_phase_seconds": training.seconds(Phase.EVALUATE),
        }
    return measured


def shares(workload: Workload, row: dict[str, Any]) -> dict[str, float]:
    """Works out the shares of a round's time from what was measured in a row; they add up to 1.

    A phase is a roll-out, perhaps the relabelling of its samples, and an update, which is the rest.
    """
    config = workload.preset().config
    policy, discriminator = config.policy_phases, config.discriminator_phases
    stepping = workload.env_steps / row["raw_env_steps_per_second"]
    rolling_out = workload.env_steps / row["rollout_env_steps_per_second"]
    relabelling = row["relabel_seconds"]
    policy_relabelling = relabelling if config.likelihood_batch else 0.0  # PPO alone needs no expert samples
    seconds = {
        "physics": (policy + discriminator) * stepping,
        "policy_and_bookkeeping": (policy + discriminator) * (rolling_out - stepping),
        "relabelling": policy * policy_relabelling + discriminator * relabelling,
        "ppo": policy * (row["ppo_phase_seconds"] - rolling_out - policy_relabelling),
        "discriminator": discriminator * (row["discriminator_phase_seconds"] - rolling_out - relabelling),
    }
    total = policy * row["ppo_phase_seconds"] + discriminator * row["discriminator_phase_seconds"]
    return {f"share_{name}": taken / total for name, taken in seconds.items()}

"""Measures training beside stepping, and which share of it is physics, the policy, relabelling or an update."""

import dataclasses
import functools
import time

import jax
import numpy as np
from jax.sharding import Mesh

from experiments.bench.speed import Size
from experiments.bench.timing import compile_timed, seconds_per_call
from experiments.paper.sizes import platform_name, sizes
from hgail_jax.config import Config, Hyperparameters, Preset
from hgail_jax.distributed.seeds import SeedsStep, compile_train_step, init_seeds, seed_keys
from hgail_jax.distributed.sharding import shard
from hgail_jax.rollout import rollout
from hgail_jax.samples import relabelled_samples
from hgail_jax.state import init_state
from hgail_jax.train import DISCRIMINATOR, EVALUATE, POLICY, PRETRAIN, SKIP, schedule
from hgail_jax.updates import make_policy


def preset(size: Size) -> Preset:
    """Returns what the task is trained with by default, in rounds of `size.num_envs` environments."""
    chosen = sizes(size.task, platform_name(), size.quick).preset
    return Preset(dataclasses.replace(chosen.config, num_envs=size.num_envs), chosen.hyperparameters)


class Training:
    """Seeds in training, to be timed phase by phase.

    Args:
      size: what each seed steps.
      seeds: side by side.
      mesh: the devices; None is one.

    """

    def __init__(self, size: Size, seeds: int = 1, mesh: Mesh | None = None):
        chosen = preset(size)
        self.config: Config = chosen.config
        self.hyperparameters: Hyperparameters = chosen.hyperparameters
        self.length = schedule(self.config).shape[1]
        states = init_seeds(size.env, self.config, self.hyperparameters, seed_keys(0, seeds))
        self._states = states if mesh is None else shard(states, mesh)

        started = time.perf_counter()
        self._step: SeedsStep = compile_train_step(size.env, self.config, states, schedule(self.config)[0], mesh)
        self.compile_seconds = time.perf_counter() - started

    def seconds(self, *phases: int) -> float:
        """Returns the seconds that a round of these phases takes; the rest of the row is skipped."""
        row = np.array([*phases] + [SKIP] * (self.length - len(phases)))

        def call():
            self._states, metrics = self._step(self._states, row)
            return metrics

        return seconds_per_call(call)

    def updates(self) -> list[int]:
        """Returns the phases of a round that learn."""
        return [POLICY] * self.config.policy_phases + [DISCRIMINATOR] * self.config.discriminator_phases


def measure_rollout(size: Size) -> dict[str, float]:
    """Times roll-outs of an untrained policy."""
    chosen = preset(size)
    state = init_state(size.env, chosen.config, chosen.hyperparameters, jax.random.key(0))

    def roll_out(state, rng):
        return rollout(size.env, make_policy(size.env, chosen.config, state, noise=1.0), rng, size.num_envs)

    compiled, _ = compile_timed(roll_out, state, jax.random.key(1))
    seconds = seconds_per_call(lambda: compiled(state, jax.random.key(1)))
    trajectory = compiled(state, jax.random.key(1))
    relabel, _ = compile_timed(
        functools.partial(relabelled_samples, size.env, chosen.hyperparameters), trajectory, jax.random.key(2)
    )
    return {
        "rollout_env_steps_per_second": size.env_steps / seconds,
        "relabel_seconds": seconds_per_call(lambda: relabel(trajectory, jax.random.key(2))),
    }


def measure_training(size: Size, each_phase: bool) -> dict[str, float]:
    """Times the phases of a round that learn, PPO and discriminator as often as by default.

    Where `each_phase`, each kind of phase alone as well.
    """
    training = Training(size)
    phases = training.updates()
    measured = {
        "train_env_steps_per_second": len(phases) * size.env_steps / training.seconds(*phases),
        "train_compile_seconds": training.compile_seconds,
    }
    if each_phase:
        measured |= {
            "ppo_phase_seconds": training.seconds(POLICY),
            "discriminator_phase_seconds": training.seconds(DISCRIMINATOR),
            "pretrain_phase_seconds": training.seconds(PRETRAIN),
            "evaluation_phase_seconds": training.seconds(EVALUATE),
        }
    return measured


def shares(size: Size, row: dict) -> dict[str, float]:
    """Works out, from what was measured in a row, the shares of a round's time; the rest is the roll-out's own."""
    training = preset(size).config
    policy, discriminator = training.policy_phases, training.discriminator_phases
    raw = size.env_steps / row["raw_env_steps_per_second"]
    rolled = size.env_steps / row["rollout_env_steps_per_second"]
    total = policy * row["ppo_phase_seconds"] + discriminator * row["discriminator_phase_seconds"]
    relabelling = discriminator + policy * (training.likelihood_batch > 0)
    parts = {
        "physics": (policy + discriminator) * raw,
        "policy_and_bookkeeping": (policy + discriminator) * (rolled - raw),
        "relabelling": relabelling * row["relabel_seconds"],
        "ppo": policy * (row["ppo_phase_seconds"] - rolled - (training.likelihood_batch > 0) * row["relabel_seconds"]),
        "discriminator": discriminator * (row["discriminator_phase_seconds"] - rolled - row["relabel_seconds"]),
    }
    return {f"share_{name}": seconds / total for name, seconds in parts.items()}

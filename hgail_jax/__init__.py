"""Hindsight generative adversarial imitation learning (Liu et al. 2019), massively vectorised in JAX.

The centre is `train_step`: a pure function from a `TrainState` and a row of `phase_table` to the next state
and the round's metrics.
"""

from hgail_envs import EpisodeMetrics, GoalEnv, make
from hgail_jax.config import EXPERT_SOURCES, PPO, REWARDS, STRATEGIES, TD3, Config, Hyperparameters
from hgail_jax.evaluate import evaluate, mean_outcome
from hgail_jax.hindsight import Hindsight, relabel
from hgail_jax.io.demonstrations import Demonstrations, load_demonstrations, save_demonstrations
from hgail_jax.io.export import export_policy
from hgail_jax.io.policy import MeanPolicy, load_policy, save_policy
from hgail_jax.methods import METHODS, Method
from hgail_jax.presets import PRESETS, Preset
from hgail_jax.rollout import Trajectory, rollout
from hgail_jax.samples import Samples
from hgail_jax.state import TrainState
from hgail_jax.train import (
    Phase,
    RoundMetrics,
    check_metrics,
    env_steps,
    init_state,
    make_policy,
    phase_table,
    train_step,
)
from hgail_jax.trainer import Trainer, TrainOptions
from hgail_jax.trainer.checkpoint import Checkpoint, Checkpoints

__version__ = "0.4.0.dev0"

__all__ = [
    "EXPERT_SOURCES",
    "METHODS",
    "PPO",
    "PRESETS",
    "REWARDS",
    "STRATEGIES",
    "TD3",
    "Checkpoint",
    "Checkpoints",
    "Config",
    "Demonstrations",
    "EpisodeMetrics",
    "GoalEnv",
    "Hindsight",
    "Hyperparameters",
    "MeanPolicy",
    "Method",
    "Phase",
    "Preset",
    "RoundMetrics",
    "Samples",
    "TrainOptions",
    "TrainState",
    "Trainer",
    "Trajectory",
    "check_metrics",
    "env_steps",
    "evaluate",
    "export_policy",
    "init_state",
    "load_demonstrations",
    "load_policy",
    "make",
    "make_policy",
    "mean_outcome",
    "phase_table",
    "relabel",
    "rollout",
    "save_demonstrations",
    "save_policy",
    "train_step",
]

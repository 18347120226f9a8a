"""Hindsight generative adversarial imitation learning (Liu et al. 2019), massively vectorised in JAX.

The centre is `train_step`: a pure function from a `TrainState` and a row of `schedule` to the next state and what the
round measured.
"""

from hgail_jax.garbage import no_search
from hgail_jax.interrupts import expect_while_importing

expect_while_importing()  # the imports below take seconds

with no_search():
    from envs import EpisodeMetrics, GoalEnv, make
    from hgail_jax.config import EXPERT_SOURCES, REWARDS, STRATEGIES, Config, Hyperparameters
    from hgail_jax.evaluate import evaluate, mean_outcome
    from hgail_jax.hindsight import Hindsight, relabel
    from hgail_jax.io.demonstrations import Demonstrations, load_demonstrations, save_demonstrations
    from hgail_jax.io.export import export_policy
    from hgail_jax.io.policy import MeanPolicy, load_policy, save_policy
    from hgail_jax.methods import METHODS, Method
    from hgail_jax.presets import PRESETS, Preset
    from hgail_jax.rollout import Trajectory, rollout
    from hgail_jax.samples import Samples
    from hgail_jax.state import TrainState, init_state
    from hgail_jax.train import Phase, RoundMetrics, check_metrics, env_steps, schedule, train_step
    from hgail_jax.trainer import Trainer, TrainOptions
    from hgail_jax.trainer.checkpoint import Checkpoint, Checkpoints
    from hgail_jax.updates import make_policy

__version__ = "0.2.0"

__all__ = [
    "EXPERT_SOURCES",
    "METHODS",
    "PRESETS",
    "REWARDS",
    "STRATEGIES",
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
    "relabel",
    "rollout",
    "save_demonstrations",
    "save_policy",
    "schedule",
    "train_step",
]

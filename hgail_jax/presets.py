"""Presets: settings that belong together, by name."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from hgail_jax.config import PPO, Config, Hyperparameters


@dataclasses.dataclass(frozen=True)
class Preset:
    """Settings that belong together."""

    config: Config = dataclasses.field(default_factory=Config)
    hyperparameters: Hyperparameters = dataclasses.field(default_factory=Hyperparameters)
    task_options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the task's class, e.g. `substeps` of the Fetch tasks."""
    evaluate_every: int = 1
    """Rounds from one evaluation to the next."""


PRESETS = {
    "parallel": Preset(),
    # The paper's sizes: batches of 128 for the policy and 64 for the discriminator, each update one pass over a
    # roll-out of 64 episodes of 50 steps. One thing is not as we read it in the paper, see `AS_WRITTEN`: one update of
    # the policy to three of the discriminator, where it has 16.
    "paper": Preset(
        Config(
            num_envs=64,
            rounds=40,
            learner=PPO(
                policy_phases=1,
                discriminator_phases=3,
                epochs=1,
                minibatches=25,
                pretrain_policy_minibatches=100,
                pretrain_policy_batch=128,
                pretrain_discriminator_minibatches=500,
                final_learning_rate=1.0,
            ),
            discriminator_minibatches=50,
            discriminator_batch=64,
        ),
        Hyperparameters(action_std=1.0, policy_learning_rate=1e-3, discriminator_learning_rate=4e-4),
    ),
}
"""`parallel` is the default: wide roll-outs and few, large updates. `paper` has the paper's sizes."""
AS_WRITTEN: dict[str, Any] = {"policy_phases": 16}
"""Changes to the `Config` of `paper` that make it the paper's, as we read it. With them the policy unlearns its
pre-training: it is updated 16 times against a discriminator that stays as it is."""
FEW_UPDATES: dict[str, Any] = {
    "minibatches": 2,
    "discriminator_minibatches": 2,
    "discriminator_batch": 16,
    "pretrain_policy_minibatches": 5,
    "pretrain_policy_batch": 16,
    "pretrain_discriminator_minibatches": 5,
}
"""Changes to a `Config` that show in seconds that everything runs, and nothing else."""

"""Sizes and hyperparameters that belong together: the presets, and what they become for a task on a platform."""

import dataclasses
from typing import Any

import jax

from envs import GoalEnv
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.validation import check_name

FEW_UPDATES: dict[str, Any] = {
    "ppo_minibatches": 2,
    "discriminator_minibatches": 2,
    "discriminator_batch": 16,
    "pretrain_policy_minibatches": 5,
    "pretrain_policy_batch": 16,
    "pretrain_discriminator_minibatches": 5,
}
"""Changes to a `Config` that show in seconds that everything runs, and nothing else."""
EVALUATION_EPISODES = {"cpu": 128, "gpu": 512}
"""Episodes per seed that a final evaluation has at least, by platform."""


@dataclasses.dataclass(frozen=True)
class Preset:
    """Sizes and hyperparameters that belong together."""

    config: Config
    hyperparameters: Hyperparameters


PRESETS = {
    "parallel": Preset(Config(), Hyperparameters()),
    # The paper's sizes: batches of 128 for the policy and 64 for the discriminator, each update one pass over a
    # roll-out of 64 episodes of 50 steps. One thing is not as we read it in the paper, see `AS_WRITTEN`: one update of
    # the policy to three of the discriminator, where it has 16.
    "paper": Preset(
        Config(
            num_envs=64,
            rounds=40,
            policy_phases=1,
            discriminator_phases=3,
            ppo_epochs=1,
            ppo_minibatches=25,
            discriminator_minibatches=50,
            discriminator_batch=64,
            pretrain_policy_minibatches=100,
            pretrain_policy_batch=128,
            pretrain_discriminator_minibatches=500,
            final_learning_rate=1.0,
        ),
        Hyperparameters(action_std=1.0, policy_learning_rate=1e-3, discriminator_learning_rate=4e-4),
    ),
}
"""`parallel` is the default: wide roll-outs and few, large updates. `paper` has the paper's sizes."""
AS_WRITTEN: dict[str, Any] = {"policy_phases": 16}
"""Changes to the `Config` of `paper` that make it what we read in the paper. With them the policy unlearns what its
pre-training taught it: it is updated 16 times against a discriminator that stays as it is."""


def platform_name() -> str:
    """Returns what JAX runs on, as defaults tell platforms apart: `"cpu"` or `"gpu"`."""
    return "cpu" if jax.default_backend() == "cpu" else "gpu"


def task_preset(task_class: type[GoalEnv], platform: str, preset: str = "parallel") -> Preset:
    """Returns a preset as a task wants it on a platform.

    Only `parallel` takes a task's own sizes and hyperparameters; another preset says itself what it consists of.

    Args:
      task_class: the task; see `GoalEnv.training`.
      platform: `"cpu"` or `"gpu"`.
      preset: a name in `PRESETS`.

    Raises:
      ValueError: there is no such preset, or the task's own sizes or hyperparameters are none.

    """
    check_name("preset", preset, PRESETS)
    base = PRESETS[preset]
    if preset != "parallel":
        return base
    try:
        defaults = task_class.training[platform]
        return Preset(
            dataclasses.replace(base.config, **defaults.config),
            base.hyperparameters.replace(**defaults.hyperparameters),
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{task_class.__name__}.training[{platform!r}] is not TrainingDefaults of fields that there are: {error}"
        ) from error

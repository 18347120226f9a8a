"""What the Fetch tasks with an object are trained with."""

from typing import Any

from envs.base import TrainingDefaults


def training_defaults(num_envs: int, rounds: int, **hyperparameters: Any) -> TrainingDefaults:
    """Returns the settings of a task with an object, with changes to them.

    A touch that teaches something is found by chance, so it takes wide roll-outs and many rounds. The likelihood of
    expert samples beside PPO teaches the hand, and a wide deviation of its command alone finds the order of opening and
    closing.
    """
    return TrainingDefaults(
        config={
            "num_envs": num_envs,
            "rounds": rounds,
            "policy_phases": 4,
            "discriminator_phases": 1,
            "ppo_minibatches": 16,
            "likelihood_batch": 2048,
            "discriminator_batch": 1024,
            "pretrain_policy_batch": 1024,
        },
        hyperparameters={
            "action_std": (0.2, 0.2, 0.2, 0.5),
            "likelihood_weight": 0.3,
            "policy_learning_rate": 1e-3,
            "discriminator_learning_rate": 2e-4,
        }
        | hyperparameters,
        options={"substeps": 8},
    )

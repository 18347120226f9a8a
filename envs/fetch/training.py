"""What the Fetch tasks with an object are trained with."""

from typing import Any

from envs.base import TrainingDefaults


def training_defaults(
    num_envs: int, rounds: int, evaluate_every: int = 1, hidden: int | None = None, **hyperparameters: Any
) -> TrainingDefaults:
    """Returns the settings of a task with an object, with changes to them.

    A touch that teaches something is found by chance, so it takes wide roll-outs and many rounds. The likelihood of
    expert samples beside PPO teaches the hand, and a wide deviation of its command alone finds the order of opening and
    closing.

    Args:
      num_envs: episodes in a roll-out.
      rounds: rounds of the training.
      evaluate_every: rounds from one evaluation to the next.
      hidden: width of the hidden layers of all networks; None leaves `Config`'s.
      hyperparameters: changes to the hyperparameters below.

    """
    widths = {} if hidden is None else {"policy_hidden": (hidden, hidden), "discriminator_hidden": (hidden, hidden)}
    return TrainingDefaults(
        config=widths
        | {
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
        evaluate_every=evaluate_every,
    )

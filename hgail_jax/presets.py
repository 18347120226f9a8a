"""What a run takes for a task on a platform unless it is told otherwise."""

import dataclasses
from typing import Any

import envs
from envs.fetch.arm import FAST_SUBSTEPS
from envs.fetch.grasp import Grasp


@dataclasses.dataclass(frozen=True)
class Defaults:
    """Changes to the preset `parallel`, and the physics."""

    config: dict[str, Any]
    hyperparameters: dict[str, Any]
    substeps: int
    """Physics steps per action in training, of the Fetch tasks."""


EVALUATION_EPISODES = {"cpu": 128, "gpu": 512}
"""Episodes per seed that a final evaluation has at least."""

REACH = {
    "cpu": Defaults({"num_envs": 64, "rounds": 6}, {}, FAST_SUBSTEPS),
    "gpu": Defaults({"num_envs": 256, "rounds": 4}, {}, FAST_SUBSTEPS),
}
"""Reach, and any task not named here."""

# A grasp is found by chance, so it takes wide roll-outs and many rounds; the likelihood of expert samples beside
# PPO teaches the hand, and a wide deviation of its command alone finds the order of opening and closing.
_GRASP_CONFIG = {
    "policy_phases": 4,
    "discriminator_phases": 1,
    "ppo_minibatches": 16,
    "likelihood_batch": 2048,
    "discriminator_batch": 1024,
    "pretrain_policy_batch": 1024,
}
_GRASP_HYPERPARAMETERS = {
    "action_std": (0.2, 0.2, 0.2, 0.5),
    "likelihood_weight": 0.3,
    "policy_learning_rate": 1e-3,
    "discriminator_learning_rate": 2e-4,
}
GRASP = {
    "cpu": Defaults(_GRASP_CONFIG | {"num_envs": 128, "rounds": 50}, _GRASP_HYPERPARAMETERS, 8),
    "gpu": Defaults(_GRASP_CONFIG | {"num_envs": 1024, "rounds": 40}, _GRASP_HYPERPARAMETERS, 8),
}
"""The three readings of grasp."""


def defaults(task_class: type[envs.GoalEnv], platform: str) -> Defaults:
    """Returns the defaults of a task on `"cpu"` or `"gpu"`."""
    return (GRASP if issubclass(task_class, Grasp) else REACH)[platform]

"""Learners: how roll-outs change the networks; one file each."""

from hgail_jax.config import Config
from hgail_jax.learners.base import Learner, Phase
from hgail_jax.learners.ppo import PPOLearner
from hgail_jax.learners.td3 import TD3Learner

__all__ = ["Learner", "Phase", "find_learner"]

_LEARNERS: dict[str, Learner] = {"ppo": PPOLearner(), "td3": TD3Learner()}


def find_learner(config: Config) -> Learner:
    """Returns the learner that a config names."""
    return _LEARNERS[config.learner.name]

"""Learners: how roll-outs change the networks; one file each."""

from hgail_jax.learner import Learner
from hgail_jax.learners.crl import CRL
from hgail_jax.learners.ppo import PPO
from hgail_jax.learners.td3 import TD3

LEARNERS: dict[str, type[Learner]] = {learner.name: learner for learner in (PPO, TD3, CRL)}
"""Learners by name."""

__all__ = ["CRL", "LEARNERS", "PPO", "TD3"]

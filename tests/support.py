"""What several test modules share."""

import contextlib
import resource
from pathlib import Path

from hgail_jax import Config

ROOT = Path(__file__).parent.parent
"""The project's folder."""

TINY = Config(
    num_envs=4,
    rounds=2,
    policy_phases=2,
    discriminator_phases=1,
    ppo_minibatches=2,
    discriminator_minibatches=3,
    discriminator_batch=8,
    pretrain_policy_minibatches=3,
    pretrain_policy_batch=8,
    pretrain_discriminator_minibatches=3,
)
"""Sizes that compile and run in seconds."""


@contextlib.contextmanager
def small_files_only(size):
    """No file may grow beyond `size` bytes: to whoever writes it, a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)

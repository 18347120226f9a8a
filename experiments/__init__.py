"""Experiments with the library, and their results; see README.md."""

from pathlib import Path
from typing import Any

import hgail_jax  # noqa: F401  (first of all, see `hgail_jax.terminal`)

RESULTS = Path(__file__).resolve().parent / "results"
"""The published results of all experiments; see its README."""
FEW_UPDATES: dict[str, Any] = {
    "minibatches": 2,
    "discriminator_minibatches": 2,
    "discriminator_batch": 16,
    "pretrain_policy_minibatches": 5,
    "pretrain_policy_batch": 16,
    "pretrain_discriminator_minibatches": 5,
}
"""Changes to a `Config` with PPO that show in seconds that everything runs, and nothing else."""

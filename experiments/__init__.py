"""Experiments with the library, and their results; see README.md."""

from pathlib import Path

import hgail_jax  # noqa: F401  (first of all, see `hgail_jax.terminal`)

RESULTS = Path(__file__).resolve().parent / "results"
"""The published results of all experiments; see its README."""

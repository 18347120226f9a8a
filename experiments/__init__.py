"""Experiments with the library, and their results; see README.md."""

import hgail_jax  # noqa: F401  (first of all, see `hgail_jax.terminal.signals`)

"""Paths of the repository's results."""

from pathlib import Path

RESULTS = Path(__file__).resolve().parent / "results"
"""The committed results of all experiments; written to only when `--out` names a folder in it."""

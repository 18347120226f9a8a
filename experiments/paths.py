"""The path of the published results."""

from pathlib import Path

RESULTS = Path(__file__).resolve().parent / "results"
"""The published results of all experiments; see its README."""

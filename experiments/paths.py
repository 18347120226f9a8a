"""Paths of the repository's results, and of the weights of its detector."""

from pathlib import Path

RESULTS = Path(__file__).resolve().parent / "results"
"""The published results of all experiments; see its README."""
WEIGHTS = Path(__file__).resolve().parent / "localisation" / "weights.npz"
"""Weights of the repository's detector, see `localisation.keypoint_network.load_detector`."""

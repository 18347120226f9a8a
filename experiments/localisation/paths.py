"""Where the repository's results are."""

from pathlib import Path

RESULTS = Path(__file__).resolve().parents[1] / "results"
"""The committed results of all experiments."""
WEIGHTS = RESULTS / "localisation" / "weights.npz"
"""Weights of the detector that comes with the repository, see `keypoint_network.load_detector`."""

"""Where the repository's results are, and where new ones go unless another folder is named."""

from pathlib import Path

RESULTS = Path(__file__).resolve().parents[1] / "results"
"""The committed results of all experiments; written to only when `--out` names a folder in it."""
OUT = Path("runs") / "transfer"
"""Default folder of what this package writes, relative to the working directory; git ignores it."""

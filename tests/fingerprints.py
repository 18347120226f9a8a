"""Prints a hash of the policies that small trainings end with; equal before and after a change that keeps training.

    git worktree add /tmp/before COMMIT
    python tests/fingerprints.py /tmp/before > before; python tests/fingerprints.py . | diff before -

Compare on one machine: compiled programs differ between processors.
"""

import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

_SMALL = ["--seeds", "2", "--num-envs", "16", "--evaluation-episodes", "16"]
_ROUNDS = "--iterations"  # as 0.3 has it, too
TRAININGS = {
    "point": ["--task", "point"],
    "point, td3": ["--task", "point", "--learner", "td3"],
    "reach": ["--task", "reach"],
    "push, td3": ["--task", "push", "--learner", "td3"],
    "stack, td3": ["--task", "stack", "--learner", "td3", "--seeds", "1"],
    "grasp with a history": ["--task", "grasp", "--randomize", "full-history", "--seeds", "1", "--num-envs", "64"],
}
"""Options of `hgail train`, by the name that is printed."""


def fingerprint(checkout: Path, options: list[str], folder: Path) -> str:
    """Trains into `folder` and returns the SHA-256 of the policies' arrays, 16 hexadecimal digits."""
    rounds = "1" if "stack" in options else "2"
    command = [sys.executable, "-m", "hgail_jax", "train", *_SMALL, _ROUNDS, rounds, *options, "--out", str(folder)]
    sources = os.environ | {"PYTHONPATH": f"{checkout}:{checkout / 'envs'}"}
    subprocess.run(command, cwd=checkout, env=sources, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    digest = hashlib.sha256()
    for path in sorted((folder / "policies").glob("*.npz")):
        with np.load(path) as arrays:
            for name in sorted(set(arrays.files) - {"header"}):
                digest.update(name.encode() + arrays[name].tobytes())
    return digest.hexdigest()[:16]


if __name__ == "__main__":
    of = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as parent:
        for index, (name, options) in enumerate(TRAININGS.items()):
            print(fingerprint(of, options, Path(parent) / str(index)), name, flush=True)

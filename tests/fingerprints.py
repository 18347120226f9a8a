"""Prints a hash of the policies that small trainings end with; equal before and after a change that keeps training.

    python -m tests.fingerprints > before; git switch other; python -m tests.fingerprints | diff before -

Compare on one machine: compiled programs differ between processors.
"""

import hashlib
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

_SMALL = ["--seeds", "2", "--num-envs", "16", "--rounds", "2", "--evaluation-episodes", "16"]
TRAININGS = {
    "point": ["--task", "point"],
    "point, td3": ["--task", "point", "--learner", "td3"],
    "reach": ["--task", "reach"],
    "push, td3": ["--task", "push", "--learner", "td3"],
    "stack, td3": ["--task", "stack", "--learner", "td3", "--seeds", "1", "--rounds", "1"],
    "grasp with a history": ["--task", "grasp", "--randomize", "full-history", "--seeds", "1", "--num-envs", "64"],
}
"""Options of `hgail train`, by the name that is printed."""


def fingerprint(options: list[str], folder: Path) -> str:
    """Trains into `folder` and returns the SHA-256 of the policies' arrays, 16 hexadecimal digits."""
    command = [sys.executable, "-m", "hgail_jax", "train", *_SMALL, *options, "--out", str(folder)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    digest = hashlib.sha256()
    for path in sorted((folder / "policies").glob("*.npz")):
        with np.load(path) as arrays:
            for name in sorted(set(arrays.files) - {"header"}):
                digest.update(name.encode() + arrays[name].tobytes())
    return digest.hexdigest()[:16]


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as parent:
        for index, (name, options) in enumerate(TRAININGS.items()):
            print(fingerprint(options, Path(parent) / str(index)), name, flush=True)

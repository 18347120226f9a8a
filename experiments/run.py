"""Trains: `python experiments/run.py --seeds 8` is `hgail train --seeds 8`."""

import sys

from hgail_jax.cli import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])

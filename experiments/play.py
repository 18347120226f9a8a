"""Shows a trained policy: `python experiments/play.py --task grasp` is `hgail play --task grasp`."""

import sys

from hgail_jax.cli import main

if __name__ == "__main__":
    main(["play", *sys.argv[1:]])

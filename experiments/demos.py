"""Records demonstrations: `python experiments/demos.py --task grasp` is `hgail demos --task grasp`."""

import sys

from hgail_jax.cli import main

if __name__ == "__main__":
    main(["demos", *sys.argv[1:]])

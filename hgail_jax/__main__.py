"""Runs the console command `hgail` as `python -m hgail_jax`."""

from hgail_jax.cli import main

if __name__ == "__main__":
    main()

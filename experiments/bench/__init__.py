"""Speed, beside the engine's own and beside other projects: `python -m experiments.bench`."""

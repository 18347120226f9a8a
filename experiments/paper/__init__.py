"""The paper's tables 1 to 3 and figures 3 to 7: `python -m experiments.paper`."""

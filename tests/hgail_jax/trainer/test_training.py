"""Training from scratch, as a user runs it."""

import json

import numpy as np
import pytest

from hgail_envs.fetch.reference import make_reference
from hgail_jax import load_policy
from hgail_jax.cli import train as run


@pytest.mark.slow
def test_two_seeds_learn_reach_and_run_in_the_reference(tmp_path):
    run.main(["--seeds", "2", "--out", str(tmp_path / "run")])
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert min(summary["success_rate"]["per_seed"]) >= 0.98
    env = make_reference("FetchReach-v4")
    for path in (tmp_path / "run" / "policies").iterdir():
        policy, successes = load_policy(path), []
        for episode in range(100):
            seen, _ = env.reset(seed=episode)
            for _ in range(50):
                inputs = np.concatenate([seen["observation"][[0, 1, 2, 5, 6, 7]], seen["desired_goal"]])
                seen, *_ = env.step(policy(inputs).astype(np.float32))
            successes.append(np.linalg.norm(seen["achieved_goal"] - seen["desired_goal"]) <= 0.05)
        assert np.mean(successes) >= 0.97

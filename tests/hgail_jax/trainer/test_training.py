"""Training from scratch, as a user runs it."""

import json

import numpy as np
import pytest

from hgail_envs.fetch.reference import make_reference
from hgail_jax import TrainOptions, load_policy
from hgail_jax.cli import train as run
from hgail_jax.trainer import training
from hgail_jax.trainer.options import plan


def test_final_evaluations_have_as_many_episodes_as_asked_for(monkeypatch):
    """Of a randomised task as trained, and without randomisation."""
    traced = []
    monkeypatch.setattr(training, "trace_evaluation", lambda env, *sizes: traced.append((env, *sizes)))
    planned = plan(TrainOptions(task="reach", seeds=1, num_envs=2, randomize="mild", evaluation_episodes=9), "cpu")
    training.trace_evaluations(planned)
    assert [(env.randomization, episodes) for env, _, _, episodes, _ in traced] == [
        (planned.env.randomization, 9),
        (planned.env.randomization.nominal(), 9),
    ]


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

"""Where the time of a round goes."""

import pytest

from experiments.bench.training import round_fractions
from experiments.bench.workload import Workload


def test_fractions_add_up_to_one_and_find_what_was_put_in():
    """A round of four PPO phases and one of the discriminator, made of parts that are known."""
    workload = Workload("grasp", "c", 4, 8, quick=True)
    raw, policy, relabel, ppo, discriminator = 1.0, 0.25, 0.125, 0.5, 2.0
    rollout = raw + policy
    found = round_fractions(
        workload,
        {
            "raw_env_steps_per_second": workload.env_steps / raw,
            "rollout_env_steps_per_second": workload.env_steps / rollout,
            "relabel_seconds": relabel,
            "ppo_phase_seconds": rollout + relabel + ppo,
            "discriminator_phase_seconds": rollout + relabel + discriminator,
        },
    )
    parts = {
        "physics": 5 * raw,
        "policy_and_bookkeeping": 5 * policy,
        "relabelling": 5 * relabel,
        "ppo": 4 * ppo,
        "discriminator": discriminator,
    }
    assert found == pytest.approx({f"share_{name}": part / sum(parts.values()) for name, part in parts.items()})

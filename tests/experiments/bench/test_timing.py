"""Calls are timed in turn, and a round's time is split."""

import pytest

from experiments.bench import timing
from experiments.bench.training import ppo_fractions, td3_fractions
from experiments.bench.workload import Workload


class Machine:
    """A clock and calls that move it on, slower by ten times after a while."""

    def __init__(self):
        self.now = 0.0
        self.order = []

    def call(self, name, seconds):
        def run():
            self.order.append(name)
            self.now += seconds * (10 if self.now > 11 else 1)

        return run


@pytest.fixture
def machine(monkeypatch):
    machine = Machine()
    monkeypatch.setattr(timing.time, "perf_counter", lambda: machine.now)
    return machine


def test_a_machine_that_slows_down_does_so_for_all_calls(machine):
    found = timing.seconds_side_by_side({"short": machine.call("short", 1.0), "long": machine.call("long", 3.0)})
    assert machine.order == ["short", "long"] * 6
    assert found["long"] / found["short"] == pytest.approx(3.0)


def test_a_long_call_is_timed_five_times_and_a_short_one_for_some_seconds(machine):
    assert timing.seconds_per_call(machine.call("long", 60.0)) == pytest.approx(600.0)
    assert machine.order == ["long"] * 6
    machine.now, machine.order = 0.0, []
    assert timing.seconds_per_call(machine.call("short", 0.125)) == pytest.approx(0.125)
    assert len(machine.order) == 1 + 33


def test_fractions_add_up_to_one_and_find_what_was_put_in():
    """A round of four PPO phases and one of the discriminator, made of parts that are known."""
    workload = Workload("grasp", "c", 4, 8, quick=True)
    raw, policy, relabel, ppo, discriminator = 1.0, 0.25, 0.125, 0.5, 2.0
    rollout = raw + policy
    found = ppo_fractions(
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


def test_fractions_of_an_update_phase_add_up_to_one_and_find_what_was_put_in():
    workload = Workload("push", "c", 4, 8, quick=True)
    row = {
        "raw_env_steps_per_second": workload.env_steps / 2.0,
        "rollout_phase_seconds": 3.0,
        "update_phase_seconds": 8.0,
    }
    found = td3_fractions(workload, row)
    assert found == {"share_physics": 0.25, "share_policy_and_bookkeeping": 0.125, "share_updates": 0.625}

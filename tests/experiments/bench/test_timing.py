"""Calls are timed in turn."""

import pytest

from experiments.bench import timing


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

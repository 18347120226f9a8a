import dataclasses

import numpy as np
import pytest

from experiments.transfer import measurement
from experiments.transfer.conditions import Conditions, NoisyEstimate
from experiments.transfer.goal_sources import TargetNotSeenError
from experiments.transfer.measurement import Point, measure, measure_rows, measured
from experiments.transfer.policies import load_policies, policy_paths
from experiments.transfer.robots import make_robot

REACH = tuple(policy_paths("reach"))


def test_a_target_that_is_never_seen_has_no_distance():
    def blind(rng):
        def look(position):
            raise TargetNotSeenError

        return look

    robot, finished = make_robot("gymnasium", "reach"), []
    outcomes = measure(robot, load_policies("reach"), range(2), 0, Conditions(blind), lambda: finished.append(1))
    row = measured(outcomes, policies=1, episodes=2)
    assert (row["success_rate"], row["not_seen"], row["distance_l1"]) == (0.0, 1.0, None)
    assert len(finished) == 2


@pytest.mark.parametrize("workers", [1, 2])
def test_rows_are_measured_in_parts_as_one_episode_after_another(workers, monkeypatch):
    monkeypatch.setattr(measurement, "_PART", 2)
    near, far = (
        Point("gymnasium", "reach", REACH, Conditions(NoisyEstimate(offset=(metres, 0.0, 0.0))), labels={"off": metres})
        for metres in (0.01, 0.08)
    )
    rows = list(measure_rows([near, far], episodes=3, seed=4, workers=workers))
    assert [row["off"] for row in rows] == [0.01, 0.08]
    robot = make_robot("gymnasium", "reach")
    for row, point in zip(rows, (near, far), strict=True):
        alone = measure(robot, load_policies("reach"), range(3), 4, point.conditions)
        assert alone.distance_l2.shape == (3,)
        assert row["distance_l2"] == pytest.approx(float(np.mean(alone.distance_l2)), abs=1e-5)
        assert row["success_rate"] == np.mean(alone.success)
        assert (row["episodes"], row["policies"]) == (3, 1)


def test_points_that_differ_in_their_labels_alone_are_measured_once(monkeypatch):
    measured_points = []
    measure_point = Point.measure
    monkeypatch.setattr(
        Point, "measure", lambda self, *rest: measured_points.append(self) or measure_point(self, *rest)
    )
    one = Point("gymnasium", "reach", REACH, labels={"name": "one"})
    other = dataclasses.replace(one, conditions=Conditions(delay=1), labels={"name": "other"})
    again = dataclasses.replace(one, labels={"name": "again"})
    rows = list(measure_rows([one, other, again], episodes=2, seed=0, workers=1))
    assert [row.pop("name") for row in rows] == ["one", "other", "again"]
    assert [point.key() for point in measured_points] == [one.key(), other.key()]
    assert rows[0] == rows[2] != rows[1]

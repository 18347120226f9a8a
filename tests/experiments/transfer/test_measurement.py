"""Points that are measured: policies, quantities that are varied, and rows of outcomes."""

import dataclasses
import hashlib
import json
import shutil
import types
from pathlib import Path

import mujoco
import numpy as np
import pytest

from experiments import RESULTS
from experiments.transfer import measurement
from experiments.transfer.conditions import Conditions, NoisyEstimate
from experiments.transfer.episode import changed
from experiments.transfer.goal_sources import TargetNotSeenError
from experiments.transfer.measurement import Point, measure, measure_rows, measured
from experiments.transfer.policies import SCRIPT, Script, find_policies, load_policies, policy_paths
from experiments.transfer.quantities import QUANTITIES
from experiments.transfer.robots import make_robot
from hgail_envs.randomization import LEVELS, Randomization
from hgail_envs.scenes import assets_directory
from hgail_jax import load_policy, save_policy

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


def test_rows_are_measured_in_parts_as_one_episode_after_another(monkeypatch):
    monkeypatch.setattr(measurement, "_PART", 2)
    near, far = (
        Point("gymnasium", "reach", REACH, Conditions(NoisyEstimate(offset=(metres, 0.0, 0.0))), labels={"off": metres})
        for metres in (0.01, 0.08)
    )
    rows = list(measure_rows([near, far], episodes=3, seed=4, workers=1))
    assert [row["off"] for row in rows] == [0.01, 0.08]
    robot = make_robot("gymnasium", "reach")
    for row, point in zip(rows, (near, far), strict=True):
        alone = measure(robot, load_policies("reach"), range(3), 4, point.conditions)
        assert alone.distance_l2.shape == (3,)
        assert row["distance_l2"] == pytest.approx(float(np.mean(alone.distance_l2)), abs=1e-5)
        assert row["success_rate"] == np.mean(alone.success)
        assert (row["episodes"], row["policies"]) == (3, 1)


def test_a_process_of_its_own_measures_the_same(monkeypatch):
    """One of the two processes that there may be; starting it takes seconds."""
    monkeypatch.setattr(measurement, "_PART", 2)
    point = Point("gymnasium", "reach", REACH, Conditions(NoisyEstimate(offset=(0.05, 0.0, 0.0))))
    here, there = (list(measure_rows([point], episodes=3, seed=4, workers=workers)) for workers in (1, 2))
    assert here == there


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


def test_the_repository_has_policies_of_each_task():
    assert len(load_policies("reach")) == 1
    assert len(load_policies("grasp")) == 8
    found = find_policies(("reach", "grasp", "pick-and-place"))
    assert {task: len(paths) for task, paths in found["plain"].items()} == {"reach": 1, "grasp": 8, "pick-and-place": 1}
    for label, level in {"other arms": "other-arms", "known delay": "full-known-delay"}.items():
        (grasp,), (picking,) = found[label]["grasp"], found[label]["pick-and-place"]
        assert (load_policy(grasp).task_options, load_policy(picking).task_options) == ({"cube": "tracked"}, {})
        for path in (grasp, picking):  # a ramp is of the training alone
            sizes = load_policy(path).randomization
            assert dataclasses.replace(sizes, ramp=LEVELS[level].ramp) == LEVELS[level]


def test_policies_that_are_shipped_are_those_that_were_published():
    published = {row["file"]: row["sha256"] for row in json.loads((RESULTS / "policies.json").read_text())}
    found = {
        path.name: path for path in (*(assets_directory() / "policies").glob("*"), *(RESULTS / "policies").glob("*"))
    }
    assert {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in found.items()} == published


def test_a_run_s_folder_stands_for_its_policies(tmp_path):
    (tmp_path / "policies").mkdir()
    file = shutil.copy(policy_paths("grasp", "other arms")[0], tmp_path / "policies" / "seed-1.npz")
    (policy,) = load_policies("grasp", tmp_path)
    assert policy.randomization == LEVELS["other-arms"]
    assert find_policies([], [f"mine={tmp_path}"]) == {"mine": {"grasp": [file]}}


def test_the_script_is_one_beside_a_folder_of_its_name(tmp_path, monkeypatch):
    (tmp_path / SCRIPT).mkdir()
    monkeypatch.chdir(tmp_path)
    (script,) = load_policies("grasp", Path(SCRIPT))
    assert isinstance(script, Script)


def test_a_task_without_a_policy_is_refused():
    with pytest.raises(ValueError, match="no policy of 'point' comes with the repository"):
        load_policies("point")


@pytest.mark.parametrize("options", [{"cube": "tracked"}, {"achieved": "passed"}])
def test_a_sweep_takes_a_policy_whose_robot_needs_to_know_no_option(options, grasp_policy, tmp_path):
    save_policy(tmp_path / "p.npz", dataclasses.replace(load_policy(grasp_policy), task_options=options))
    assert find_policies([], [f"other={tmp_path / 'p.npz'}"]) == {"other": {"grasp": [tmp_path / "p.npz"]}}


def test_a_sweep_refuses_a_policy_of_other_task_options(shipped_policy, tmp_path):
    save_policy(tmp_path / "p.npz", dataclasses.replace(load_policy(shipped_policy), task_options={"size": 3}))
    with pytest.raises(ValueError, match="trained with task options size=3; curves are of tasks as they are alone"):
        find_policies(["reach"], [f"other={tmp_path / 'p.npz'}"])


@pytest.mark.parametrize("task", ["grasp", "pick-and-place"])
def test_a_script_does_the_task_as_a_policy(task):
    outcomes = measure(make_robot("gymnasium", task), load_policies(task, Path(SCRIPT)), range(4), 0, Conditions())
    assert outcomes.success.tolist() == [1.0] * 4


XML = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
  <body name="arm" gravcomp="1" pos="0 0 1"><joint type="slide" axis="0 0 1"/><geom size=".1" mass="3"/></body>
  <body name="cube" pos="1 0 1"><freejoint/><geom name="cube" type="box" size=".1 .1 .1" mass="2"/></body>
  </worldbody></mujoco>"""


def fields(model):
    return {name: getattr(model, name).copy() for name in dir(model) if isinstance(getattr(model, name), np.ndarray)}


def test_it_changes_what_it_says_and_undoes_it():
    model = mujoco.MjModel.from_xml_string(XML)
    robot, before = types.SimpleNamespace(model=model, cube="cube"), fields(model)
    with changed(robot, friction=0.5, object_mass=3.0, gravity=0.2):
        np.testing.assert_allclose(model.geom_friction, 0.5 * before["geom_friction"])
        np.testing.assert_allclose(model.body("cube").mass, 6.0)
        np.testing.assert_allclose(model.body("cube").inertia, 3.0 * before["body_inertia"][2])
        np.testing.assert_allclose(model.body("cube").invweight0, before["body_invweight0"][2] / 3.0)
        assert model.body("arm").mass == 3.0
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.qacc[0], -0.2 * 9.81)  # the arm falls with what is left of its weight
    for name, values in fields(model).items():
        np.testing.assert_allclose(values, before[name], err_msg=name)


def test_nothing_is_changed_by_default():
    with changed(None, friction=1.0, object_mass=1.0, gravity=0.0):  # it asks for no model
        pass


@pytest.mark.parametrize("quantity", QUANTITIES.values(), ids=QUANTITIES.keys())
def test_every_quantity_is_varied_from_its_nominal_value(quantity):
    """On other robots, on this package's Fetch, or on both."""
    varied = []
    if quantity.conditions:
        varied.append(([quantity.conditions(value) for value in quantity.values], Conditions()))
    if quantity.sizes:
        varied.append(([Randomization(**quantity.sizes(value)) for value in quantity.values], Randomization()))
    assert varied
    for points, nominal in varied:
        assert nominal in points
        assert len(set(points)) == len(quantity.values)


@pytest.mark.parametrize(("axis", "moved"), [("x", [0.03, 0, 0]), ("y", [0, 0.03, 0]), ("z", [0, 0, 0.03])])
def test_an_offset_moves_its_own_axis(axis, moved):
    estimate = QUANTITIES[f"offset {axis}"].conditions(0.03).estimate
    np.testing.assert_allclose(estimate(np.random.default_rng(0))(np.zeros(3)), moved)


def test_delay_and_stride_are_conditions_of_actions():
    assert QUANTITIES["delay"].conditions(2) == Conditions(delay=2)
    assert QUANTITIES["stride"].conditions(1.5) == Conditions(stride=1.5)


def test_a_task_has_the_quantities_that_affect_it():
    def of(task):
        return {name for name, quantity in QUANTITIES.items() if task in quantity.tasks}

    about_object = {"mass", "size", "finger force", "finger speed", "hand opening"}
    in_sight = {"object offset", "object noise"}
    assert of("pick-and-place") == set(QUANTITIES)
    assert of("grasp") == set(QUANTITIES) - in_sight
    assert of("reach") == set(QUANTITIES) - in_sight - about_object

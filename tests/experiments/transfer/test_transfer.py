"""The command line of transfer, its table and its pictures."""

import contextlib
import csv
import json
import types

import imageio.v3 as imageio
import numpy as np
import pytest

from experiments.localisation.localiser import TargetNotSeenError
from experiments.transfer import __main__ as transfer
from experiments.transfer import camera_goal
from experiments.transfer import studies as transfer_studies
from experiments.transfer.figures import draw_curves

QUICK = ["--episodes", "2"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--episodes", "0"], "episodes is 0; it must be at least 1"),
        (["--to", "mars"], "mars"),
        (["--task", "point"], "point"),
        (["--delay", "-1"], "delay is -1; it must be at least 0"),
        (["--noise", "-0.1"], "noise is -0.1; it must be at least 0"),
        (["--stride", "3"], "stride is 3.0; it must be from 0 to 2.0"),
        (["--offset", "0", "0", "nan"], "each number must be from -1.0 to 1.0 m"),
        (["--policy", "none.npz"], "none.npz"),
        (["--table", "4", "--sweep"], "choose one of"),
        (["--table", "4", "--to", "ur5e"], "--to does not go with"),
        (["--stage", "camera"], "--stage goes with --table"),
        (["--table", "4", "--stage", "none"], "none"),
        (["--sweep", "--out", "nowhere"], "there is no folder nowhere"),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        transfer.main(arguments)
    assert exit_info.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert message in error
    assert not list(tmp_path.iterdir())


def test_a_policy_of_another_task_is_refused(shipped_policy, capsys):
    with pytest.raises(SystemExit) as exit_info:
        transfer.main(["--task", "grasp", "--policy", str(shipped_policy)])
    assert exit_info.value.code == 2
    assert "the policy is for 'reach', not for 'grasp'" in capsys.readouterr().err


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(transfer_studies.ROBOTS, "gymnasium", ("no_such_module", "Robot", "compare"))
    with pytest.raises(ValueError, match=r"needs the package no_such_module; pip install -e .*compare"):
        transfer_studies.make_robot("gymnasium", "reach", absent=1)


def test_one_run(capsys):
    transfer.main(["--to", "gymnasium", "--task", "reach", *QUICK])
    printed = capsys.readouterr().out
    # Wilson for 2 of 2 by its formula: from n / (n + z²) to 1
    assert f"success 1.000 (95 % interval {2 / (2 + 1.959964**2):.3f} to 1.000)" in printed
    assert "2 episodes, 1 policies" in printed


def read_table(folder):
    with (folder / "table4.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_table(tmp_path, monkeypatch):
    """A row for each stage, robot, task and way; measured once where only labels differ."""
    monkeypatch.delitem(transfer_studies.ROBOTS, "ur5e")
    monkeypatch.delitem(transfer_studies.STAGES, "camera goal")
    monkeypatch.setitem(transfer_studies.STAGES, "again", lambda robot, stack: transfer_studies.exact)
    transfer.main(["--table", "4", *QUICK, "--out", str(tmp_path)])
    rows = read_table(tmp_path)
    assert [(row["stage"], row["task"]) for row in rows] == [
        (stage, task) for stage in ("exact goal", "again") for task in ("reach", "grasp")
    ]
    assert all(row["episodes"] == "2" and 0 <= float(row["success_low"]) <= float(row["success_rate"]) for row in rows)
    assert [row["success_rate"] for row in rows[:2]] == [row["success_rate"] for row in rows[2:]]
    made_by = json.loads((tmp_path / "table4.json").read_text())
    assert made_by["exact goal"] == made_by["again"]
    assert made_by["again"]["episodes"] == 2
    assert "mujoco" in made_by["again"]["versions"]


class FakeLocaliser(contextlib.AbstractContextManager):
    """Knows where the target is, and sees it every other time."""

    calls = closed = 0

    def __init__(self, cameras, detect, cube):
        self.cube = cube

    def __call__(self, model, data, rng, marker=None):
        FakeLocaliser.calls += 1
        if FakeLocaliser.calls % 2:
            raise TargetNotSeenError
        return data.geom(self.cube).xpos if marker is None else marker

    def __exit__(self, *exception):
        FakeLocaliser.closed += 1


def test_the_camera_s_rows_join_the_exact_goal_s(tmp_path, monkeypatch):
    """Episodes whose target is not seen have failed; the others go as with the exact goal. A second time replaces."""
    monkeypatch.delitem(transfer_studies.ROBOTS, "ur5e")
    monkeypatch.setattr(camera_goal, "open_renderer", lambda *arguments: types.SimpleNamespace(close=lambda: None))
    monkeypatch.setattr(camera_goal, "Localiser", FakeLocaliser)
    for stage in ("exact", "camera", "camera"):
        transfer.main(["--table", "4", "--stage", stage, *QUICK, "--out", str(tmp_path)])
    rows = read_table(tmp_path)
    assert [row["stage"] for row in rows] == ["exact goal"] * 2 + ["camera goal"] * 2
    assert [row["not_seen"] for row in rows] == ["0.0"] * 2 + ["0.5"] * 2
    assert [row["success_rate"] for row in rows] == ["1.0"] * 2 + ["0.5"] * 2
    assert [row["achieved_rate"] for row in rows] == ["1.0"] * 2 + ["0.5"] * 2
    assert all(0.0 < float(row["distance_l2"]) < 0.05 for row in rows)
    assert FakeLocaliser.closed == 4
    assert list(json.loads((tmp_path / "table4.json").read_text())) == ["exact goal", "camera goal"]


def test_a_target_that_is_never_seen_has_no_distance():
    def blind(position, rng):
        raise TargetNotSeenError

    robot, policies = transfer_studies.make_robot("gymnasium", "reach"), transfer_studies.load_policies("reach")
    measured = transfer_studies.measure(robot, policies, 2, 0, transfer_studies.Conditions(blind), lambda: None)
    assert (measured["success_rate"], measured["not_seen"], measured["distance_l1"]) == (0.0, 1.0, None)


@pytest.mark.parametrize("task", ["reach", "grasp"])
def test_cameras_see_the_robot_s_own_frame(task):
    """The ball is put where the target is in the scene; what is seen comes back in the policy's frame."""
    offset, put = np.array([1.0, 2.0, 3.0]), []

    def localiser(model, data, rng, marker):
        put.append(marker)
        return np.array([0.1, 0.2, 0.3])

    robot = types.SimpleNamespace(task=task, offset=offset, model=None, data=None)
    estimate = camera_goal.seen(robot, localiser)(np.array([1.5, 2.5, 3.5]), np.random.default_rng(0))
    np.testing.assert_allclose(estimate, [1.1, 2.2, 3.3])
    if task == "reach":
        np.testing.assert_allclose(put[0], 0.5)
    else:
        assert put == [None]


def test_without_a_renderer_nothing_is_measured(tmp_path, monkeypatch, capsys):
    def refuse(*arguments):
        raise RuntimeError("MuJoCo cannot render here, install EGL or OSMesa (no display)")

    monkeypatch.setattr(camera_goal, "open_renderer", refuse)
    with pytest.raises(SystemExit) as exit_info:
        transfer.main(["--table", "4", *QUICK, "--out", str(tmp_path)])
    assert exit_info.value.code == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "install EGL or OSMesa" in error
    assert not list(tmp_path.iterdir())


def test_every_quantity_is_varied_from_nothing():
    for quantity, values in transfer_studies.QUANTITIES.items():
        conditions = [transfer_studies.condition(quantity, value) for value in values]
        assert transfer_studies.Conditions() in conditions
        assert len(set(conditions)) == len(values)
    rng = np.random.default_rng(0)
    moved = transfer_studies.condition("offset y", 0.03).estimate(np.zeros(3), rng)
    np.testing.assert_allclose(moved, [0.0, 0.03, 0.0])


def test_curves_have_an_ink_for_each_line(tmp_path):
    """A second robot's line changes the picture."""
    row = {"robot": "A, b", "task": "reach", "quantity": "noise", "value": 0.0, "success_rate": 0.5}
    rows = [row | {"success_low": 0.4, "success_high": 0.6}]
    pictures = []
    for drawn in (rows, [*rows, rows[0] | {"robot": "C, d", "success_rate": 0.2, "success_low": 0.1}]):
        draw_curves(tmp_path / "curves.png", drawn)
        pictures.append(imageio.imread(tmp_path / "curves.png"))
    assert (pictures[0] != pictures[1]).any()
    assert list(tmp_path.iterdir()) == [tmp_path / "curves.png"]


@pytest.mark.slow
def test_pictures_of_the_ur5e(tmp_path):
    transfer.main(["--pictures", "--out", str(tmp_path)])
    picture = imageio.imread(tmp_path / "transfer-ur5e.png")
    assert picture.shape == (480, 6 * 240, 3)
    assert (picture[:, :240] != picture[:, -240:]).mean() > 0.1
    assert (tmp_path / "transfer-ur5e.png").stat().st_size < 300_000

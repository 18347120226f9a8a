"""The command line: its checks, a single run, and where it writes by default."""

import dataclasses

import pytest

from experiments.transfer import __main__ as transfer
from experiments.transfer.disturbances import DISTURBANCES
from experiments.transfer.paths import RESULTS
from experiments.transfer.robots import ROBOTS

SWEEP = ["--sweep", "--to", "gymnasium", "--workers", "1"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--episodes", "0"], "episodes is 0; it must be at least 1"),
        (["--to", "mars"], "--to is 'mars'; choose from fetch, gymnasium, ur5e, franka\n"),
        (["--task", "point"], "--task is 'point'; choose from reach, grasp, push, pick-and-place, slide\n"),
        (["--delay", "-1"], "delay is -1; it must be at least 0"),
        (["--noise", "-0.1"], "noise is -0.1; it must be at least 0"),
        (["--stride", "3"], "stride is 3.0; it must be from 0 to 2.0"),
        (["--offset", "0", "0", "nan"], "each number must be from -1.0 to 1.0 m"),
        (["--policy", "none.npz"], "none.npz"),
        (["--table", "4", "--sweep"], "choose one of"),
        (["--table", "4", "--to", "ur5e"], "--to does not go with"),
        (["--policies", "a=b.npz"], "--policies goes with --sweep"),
        (["--workers", "2"], "--workers goes with --table and --sweep"),
        (["--to", "fetch"], "--to fetch goes with --sweep"),
        (["--sweep", "--workers", "0"], "workers is 0; it must be at least 1"),
        (["--sweep", "--policies", "full"], "policies 'full' is not label=path"),
        (["--sweep", "--policies", "full=none.npz"], "there is no file none.npz"),
        (["--sweep", "--policies", "full=."], "there is no policy in ."),
        (["--sweep", "--to", "ur5e", "--task", "slide"], "ur5e has no curves of 'slide'"),
        (["--goal-source", "camera"], "--goal-source goes with --table"),
        (["--table", "4", "--goal-source", "none"], "none"),
        (["--sweep", "--out", "/dev/null"], "cannot make the folder /dev/null"),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_info:
        transfer.main(arguments)
    assert exit_info.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("transfer: ")
    assert error.count("\n") == 1
    assert message in error
    assert not list(tmp_path.iterdir())


def test_help_lists_what_can_be_chosen(capsys):
    with pytest.raises(SystemExit):
        transfer.main(["--help"])
    shown = capsys.readouterr().out
    assert "--to {fetch,gymnasium,ur5e,franka}" in shown
    assert "None" not in shown


def test_a_policy_of_another_task_is_refused(shipped_policy, capsys):
    with pytest.raises(SystemExit) as exit_info:
        transfer.main(["--task", "grasp", "--policy", str(shipped_policy)])
    assert exit_info.value.code == 2
    assert "the policy is for 'reach', not for 'grasp'" in capsys.readouterr().err


def test_one_run(capsys):
    transfer.main(["--to", "gymnasium", "--task", "reach", "--episodes", "2"])
    printed = capsys.readouterr().out
    # Wilson for 2 of 2 by its formula: from n / (n + z²) to 1
    assert f"success 1.000 (95 % interval {2 / (2 + 1.959964**2):.3f} to 1.000)" in printed
    assert "2 episodes, 1 policy\n" in printed


@pytest.mark.parametrize(
    ("arguments", "written"),
    [
        (
            ["--table", "4", "--goal-source", "exact", "--workers", "1", "--episodes", "1"],
            {"table4.csv", "table4.json"},
        ),
        (
            ["--sweep", "--to", "gymnasium", "--workers", "1", "--episodes", "1"],
            {f"transfer-sweep.{end}" for end in ("csv", "json", "png")},
        ),
        (["--pictures"], {"transfer-gymnasium.png"}),
    ],
)
def test_by_default_the_committed_results_are_left_alone(arguments, written, tmp_path, monkeypatch, request):
    if "--pictures" in arguments:
        request.getfixturevalue("rendering")
    monkeypatch.chdir(tmp_path)
    for robot in ("ur5e", "franka"):
        monkeypatch.delitem(ROBOTS, robot)
    for quantity, disturbance in DISTURBANCES.items():
        least = dataclasses.replace(disturbance, values=disturbance.values[:1])
        monkeypatch.setitem(DISTURBANCES, quantity, least)
    before = committed()
    transfer.main(arguments)
    assert {path.name for path in (tmp_path / "runs" / "transfer").iterdir()} == written
    assert committed() == before


def committed():
    """Returns when each committed result was last written."""
    results = list((RESULTS / "transfer").iterdir())
    assert results
    return {path: path.stat().st_mtime_ns for path in results}

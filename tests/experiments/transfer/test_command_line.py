"""The command line: its checks, a single run, and where it writes by default."""

import dataclasses

import numpy as np
import pytest

from experiments import RESULTS
from experiments.transfer import __main__ as transfer
from experiments.transfer.conditions import NoisyEstimate
from experiments.transfer.goal_sources import GOAL_SOURCES
from experiments.transfer.quantities import QUANTITIES
from experiments.transfer.robots import ROBOTS, make_robot
from hgail_envs.randomization import Randomization
from hgail_jax import load_policy, save_policy
from hgail_jax.policy import MeanPolicy
from tests.support import ROOT, refused

SWEEP = ["--sweep", "--to", "gymnasium", "--workers", "1"]
GRASP = ROOT / "assets" / "policies" / "grasp.npz"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--episodes", "0"], "episodes is 0; it must be at least 1"),
        (["--to", "mars"], "invalid choice 'mars' for argument '--to'"),
        (["--task", "point"], "invalid choice 'point' for argument '--task'"),
        (["--delay", "-1"], "delay is -1; it must be at least 0"),
        (["--noise", "-0.1"], "noise is -0.1; it must be at least 0"),
        (["--stride", "3"], "stride is 3.0; it must be from 0 to 2.0"),
        (["--offset", "0", "0", "nan"], "each number must be from -1.0 to 1.0 m"),
        (["--policy", "none.npz"], "none.npz"),
        (["--table", "4", "--sweep"], "choose one of"),
        (["--table", "4", "--robot-options", "slowdown=1"], "--robot-options does not go with"),
        (["--table", "4", "--task", "push"], "table 4 has no rows of this"),
        (
            ["--table", "4", "--to", "ur5e", "--task", "pick-and-place", "--goal-source", "camera"],
            "table 4 has no rows",
        ),
        (["--robot-options", "slowdown"], "robot option 'slowdown' is not name=value"),
        (["--robot-options", "slowdown=2"], "gymnasium has no option 'slowdown'; it has observation"),
        (["--robot-options", "observation=official"], "observation is 'official'; choose from compact\n"),
        (["--to", "ur5e", "--robot-options", "slowdown=0"], "slowdown is 0; it must be at least 1"),
        (["--to", "ur5e", "--robot-options", "start_open=1"], "start_open is 1; it must be true or false"),
        (["--to", "ur5e", "--robot-options", "robot=ur5e"], "robot is no option of --robot-options"),
        (["--policies", "a=b.npz"], "--policies goes with --sweep"),
        (["--workers", "2"], "--workers goes with --table and --sweep"),
        (["--to", "fetch"], "--to fetch goes with --sweep"),
        (["--sweep", "--workers", "0"], "workers is 0; it must be at least 1"),
        (["--sweep", "--policies", "full"], "policies 'full' is not label=path"),
        (["--sweep", "--policies", "full=none.npz"], "there is no file or folder none.npz"),
        (["--sweep", "--policies", "a=script"], "there is no file or folder script"),
        (["--sweep", "--policies", "full=."], ". does not hold a policy"),
        (["--sweep", "--task", "reach", "--policies", f"a={GRASP}"], "--policies a has no policy of reach"),
        (["--sweep", "--to", "ur5e", "--task", "slide"], "ur5e has no curves of 'slide'"),
        (["--sweep", "--goal-source", "camera"], "--goal-source does not go with"),
        (["--goal-source", "camera", "--noise", "0.01"], "--noise and --offset are of the exact goal"),
        (
            ["--goal-source", "camera", "--task", "push"],
            "cameras cannot see the target of 'push'; they can of reach, g",
        ),
        (["--table", "4", "--goal-source", "none"], "none"),
        (["--sweep", "--out", "/dev/null"], "cannot make the folder /dev/null"),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line = refused(transfer.main, arguments, message, capsys)
    assert line.startswith("transfer: ") and "'None'" not in line  # a default, no choice
    assert not list(tmp_path.iterdir())


def test_help_lists_what_can_be_chosen(capsys):
    with pytest.raises(SystemExit):
        transfer.main(["--help"])
    shown = capsys.readouterr().out
    assert "--to {fetch,gymnasium,ur5e,franka}" in shown
    assert "None" not in shown


def test_a_policy_of_another_task_is_refused(shipped_policy, capsys):
    words = ["--task", "grasp", "--policy", str(shipped_policy)]
    refused(transfer.main, words, "the policy is for 'reach', not for 'grasp'", capsys)


def test_one_run(capsys):
    transfer.main(["--to", "gymnasium", "--task", "reach", "--episodes", "2"])
    printed = capsys.readouterr().out
    # Wilson for 2 of 2 by its formula: from n / (n + z²) to 1
    assert printed.startswith(f"{ROBOTS['gymnasium'].name}, reach, hand closed at the start, 40 ms an action: success")
    assert f"success 1.000 (95 % interval {2 / (2 + 1.959964**2):.3f} to 1.000)" in printed
    assert "2 episodes, 1 policy\n" in printed


def test_one_run_of_the_script(capsys):
    transfer.main(["--to", "gymnasium", "--task", "grasp", "--episodes", "2", "--policy", "script"])
    assert "success 1.000" in capsys.readouterr().out


def test_a_delay_that_the_policy_does_not_know_is_refused(tmp_path, capsys):
    size = 2 * (1 + 4) + 12
    layers = ((np.zeros((size, 4), np.float32), np.zeros(4, np.float32)),)
    sizes, known = (np.zeros(size, np.float32), np.ones(size, np.float32)), Randomization(known_delay=2)
    save_policy(tmp_path / "p.npz", MeanPolicy("grasp", 4, *sizes, layers, randomization=known))
    chosen = ["--to", "gymnasium", "--task", "grasp", "--episodes", "1", "--policy", str(tmp_path / "p.npz")]
    transfer.main([*chosen, "--delay", "2"])
    with pytest.raises(SystemExit) as exit_info:
        transfer.main([*chosen, "--delay", "3"])
    assert exit_info.value.code == 2
    assert capsys.readouterr().err.endswith("transfer: delay is 3; the policy knows delays from 0 to 2\n")


def test_a_policy_that_tracks_the_cube_runs_on_a_robot_that_knows_no_such_option(tmp_path, capsys):
    """Which it reads eleven features of, two more times with an action in its history, and the goal."""
    size = 2 * (4 + 11) + 11 + 4
    layers = ((np.zeros((size, 4), np.float32), np.zeros(4, np.float32)),)
    history, options = Randomization(history=2), {"cube": "tracked"}
    policy = MeanPolicy(
        "grasp",
        4,
        np.zeros(size, np.float32),
        np.ones(size, np.float32),
        layers,
        randomization=history,
        task_options=options,
    )
    save_policy(tmp_path / "p.npz", policy)
    transfer.main(["--to", "gymnasium", "--task", "grasp", "--episodes", "2", "--policy", str(tmp_path / "p.npz")])
    assert "success 0.000" in capsys.readouterr().out
    save_policy(tmp_path / "p.npz", dataclasses.replace(policy, task_options={}))
    with pytest.raises(SystemExit) as exit_info:
        transfer.main(["--to", "gymnasium", "--task", "grasp", "--policy", str(tmp_path / "p.npz")])
    assert exit_info.value.code == 2
    assert capsys.readouterr().err.endswith("transfer: an observation of grasp has 45 numbers\n")


def test_one_run_takes_its_goal_from_the_source_that_is_named(capsys, monkeypatch):
    monkeypatch.setitem(GOAL_SOURCES, "camera", lambda robot: NoisyEstimate(offset=(0.3, 0.0, 0.0)))
    transfer.main(["--task", "reach", "--episodes", "2", "--goal-source", "camera", "--delay", "3", "--stride", "0.5"])
    printed = capsys.readouterr().out
    assert "success 0.000" in printed
    assert ", 40 ms an action, goal by camera, delay of 3 steps, steps × 0.5: success" in printed


def test_one_run_prints_the_error_of_the_goal(capsys):
    transfer.main(["--episodes", "1", "--noise", "0.25", "--offset", "0.5", "0", "0"])
    named = "goal off by 0.25 m (σ), goal off by (0.5, 0.0, 0.0) m"
    assert f", 40 ms an action, {named}: success" in capsys.readouterr().out


def test_one_run_with_options_of_the_robot(monkeypatch, capsys):
    made = []

    def make_slow(*named, **options):
        made.append(options)
        robot = make_robot(*named)
        robot.slowdown, robot.starts_closed = options["slowdown"], not options["start_open"]
        return robot

    monkeypatch.setattr(transfer, "make_robot", make_slow)
    transfer.main(["--to", "gymnasium", "--episodes", "1", "--robot-options", "slowdown=2", "start_open=true"])
    assert made == [{"slowdown": 2, "start_open": True}]
    assert "reach, hand open at the start, 80 ms an action: success" in capsys.readouterr().out


def test_a_policy_of_the_official_observation_runs_in_the_official_environment(tmp_path, capsys):
    """Which it reads 25 numbers of, and the goal and whose it is."""
    rng = np.random.default_rng(0)
    sizes = [(29, 8), (8, 4)]
    layers = tuple((rng.normal(size=size).astype(np.float32), np.zeros(size[1], np.float32)) for size in sizes)
    policy = MeanPolicy(
        "push", 4, np.zeros(29, np.float32), np.ones(29, np.float32), layers, task_options={"observation": "official"}
    )
    save_policy(tmp_path / "p.npz", policy)
    transfer.main(["--task", "push", "--episodes", "2", "--policy", str(tmp_path / "p.npz")])
    assert "2 episodes, 1 policy\n" in capsys.readouterr().out
    save_policy(tmp_path / "lifts.npz", dataclasses.replace(policy, task="pick-and-place"))
    with pytest.raises(SystemExit):
        transfer.main(["--task", "pick-and-place", "--to", "ur5e", "--policy", str(tmp_path / "lifts.npz")])
    assert "ur5e has no option 'observation'; it has slowdown, start_open\n" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("robot", "to", "line"),
    [
        ("so101", [], "policies go to gymnasium, ur5e, franka, not to so101: hgail evaluate --reference is for it"),
        ("franka", ["--to", "ur5e"], "policies of 'franka' do not go to ur5e; those of the Fetch or of ur5e do"),
        ("ur5e", ["--to", "gymnasium"], "policies of 'ur5e' do not go to gymnasium; those of the Fetch do"),
    ],
)
def test_an_arm_s_policy_goes_to_that_arm(robot, to, line, tmp_path, capsys, shipped_policy):
    policy = load_policy(shipped_policy)
    save_policy(tmp_path / "p.npz", dataclasses.replace(policy, task_options={"robot": robot}))
    refused(transfer.main, ["--policy", str(tmp_path / "p.npz"), *to], line, capsys)


def test_an_arm_s_policy_is_measured_there_unless_said_otherwise(tmp_path, capsys, shipped_policy):
    policy = load_policy(shipped_policy)
    save_policy(tmp_path / "p.npz", dataclasses.replace(policy, task_options={"robot": "ur5e"}))
    transfer.main(["--policy", str(tmp_path / "p.npz"), "--episodes", "1"])
    assert capsys.readouterr().out.startswith("UR5e with Robotiq 2F-85, C MuJoCo, reach")


@pytest.mark.parametrize(
    ("arguments", "written"),
    [
        (
            ["--table", "4", "--goal-source", "exact", "--workers", "1", "--episodes", "1"],
            {"table4.json"},
        ),
        (
            ["--sweep", "--task", "reach", "--to", "gymnasium", "--workers", "1", "--episodes", "1"],
            {"transfer-sweep.json", "transfer-sweep-gymnasium.png"},
        ),
    ],
)
def test_by_default_the_committed_results_are_left_alone(arguments, written, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for robot in ("ur5e", "franka"):
        monkeypatch.delitem(ROBOTS, robot)
    for name, quantity in QUANTITIES.items():
        least = dataclasses.replace(quantity, values=quantity.values[:1])
        monkeypatch.setitem(QUANTITIES, name, least)
    before = committed()
    transfer.main(arguments)
    assert {path.name for path in (tmp_path / "runs" / "transfer").iterdir()} == written
    assert set(capsys.readouterr().out.split()) == {f"runs/transfer/{name}" for name in written}
    assert committed() == before


def committed():
    """Returns when each committed result was last written."""
    results = list(RESULTS.iterdir())
    assert results
    return {path: path.stat().st_mtime_ns for path in results}

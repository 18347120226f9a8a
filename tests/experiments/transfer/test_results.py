"""The table, its rows that are kept, figures, and a user's robot in table and curves."""

import dataclasses
import itertools
import json

import imageio.v3 as imageio
import mujoco
import numpy as np
import pytest
from matplotlib import colors

from experiments.transfer import __main__ as transfer
from experiments.transfer import goal_sources, policies, results
from experiments.transfer.conditions import NoisyEstimate
from experiments.transfer.figures import draw_sweep
from experiments.transfer.goal_sources import GOAL_SOURCES
from experiments.transfer.policies import FILES, find_policies
from experiments.transfer.quantities import QUANTITIES
from experiments.transfer.results import write_sweep, write_table
from experiments.transfer.robots import ROBOTS, GymnasiumFetch
from experiments.transfer.robots.base import OptionCurve, Robot
from hgail_jax.io.policy import load_policy, save_policy


def read(folder, name="table4"):
    """The rows of a file, and what made them."""
    content = json.loads((folder / f"{name}.json").read_text())
    return content["rows"], content["made_by"]


@pytest.fixture(autouse=True)
def plain_alone(monkeypatch):
    for label in set(FILES) - {"plain"}:
        monkeypatch.delitem(FILES, label)
    monkeypatch.setattr(policies, "SCRIPTED_TASKS", ())


def measure_table(folder, source):
    more = ["--goal-source", source, "--workers", "1", "--episodes", "2", "--out", str(folder)]
    transfer.main(["--table", "4", *more])


def test_the_table(tmp_path, monkeypatch):
    """A row for each goal source, robot, task, variant and policy; cameras see no place in the air."""
    for robot in ("ur5e", "franka"):
        monkeypatch.delitem(ROBOTS, robot)
    for source in list(GOAL_SOURCES):
        if source != "exact":
            monkeypatch.delitem(GOAL_SOURCES, source)
    monkeypatch.setitem(GOAL_SOURCES, "second", lambda robot: NoisyEstimate())
    plain = find_policies(("reach", "grasp", "pick-and-place"))["plain"]
    save_policy(tmp_path / "seen.npz", tracking(load_policy(plain["grasp"][0])))
    both = {"plain": plain, "other": {"grasp": [tmp_path / "seen.npz"]}}
    monkeypatch.setattr(policies, "find_policies", lambda tasks: both)
    monkeypatch.setattr(policies, "SCRIPTED_TASKS", ("grasp",))
    transfer.main(["--table", "4", "--workers", "1", "--episodes", "2", "--out", str(tmp_path)])
    rows, made_by = read(tmp_path)
    of_grasp = [("grasp", "plain", "at-start"), ("grasp", "other", "tracked"), ("grasp", "script", "at-start")]
    seen = [("reach", "plain", None), *of_grasp]
    assert [(row["stage"], row["task"], row["policy"], row["cube"]) for row in rows] == [
        *[("exact goal", *row) for row in [*seen, ("pick-and-place", "plain", None)]],
        *[("second goal", *row) for row in seen],
    ]
    assert all(row["episodes"] == 2 and 0 <= row["success_low"] <= row["success_rate"] for row in rows)
    assert [row["distance_l2"] for row in rows[:4]] == [row["distance_l2"] for row in rows[5:]]
    assert {row["paper_success"] for row in rows if row["task"] == "pick-and-place"} == {None}
    assert set(made_by) == {f"{row['stage']}: {row['robot']}: {row['task']}" for row in rows}
    of_grasp = made_by[f"second goal: {GymnasiumFetch.name}: grasp"]
    assert of_grasp == made_by[f"exact goal: {GymnasiumFetch.name}: pick-and-place"]
    assert of_grasp["episodes"] == 2
    assert {"mujoco", "gymnasium-robotics"} <= of_grasp["versions"].keys()


def tracking(policy):
    """Returns a policy with three more numbers in its observation, which it ignores: the cube less the gripper."""
    (weights, *rest), *others = policy.layers
    return dataclasses.replace(
        policy,
        mean=np.insert(policy.mean, [8] * 3, 0.0),
        std=np.insert(policy.std, [8] * 3, 1.0),
        layers=((np.insert(weights, [8] * 3, 0.0, axis=0), *rest), *others),
        task_options={"cube": "tracked"},
    )


@pytest.fixture
def half_blind(monkeypatch):
    """Cameras that see the target every other time."""
    looks = itertools.count()
    monkeypatch.setattr(goal_sources, "sees", lambda robot, camera, target: next(looks) // 2 % 2 == 1)


def test_the_camera_s_rows_join_the_exact_goal_s(tmp_path, monkeypatch, half_blind):
    """Episodes whose target is not seen have failed; the others go as with the exact goal. A second time replaces."""
    for robot in ("ur5e", "franka"):
        monkeypatch.delitem(ROBOTS, robot)
    monkeypatch.setattr(policies, "find_policies", lambda tasks: find_policies(("reach", "grasp")))
    for source in ("exact", "camera", "camera"):
        measure_table(tmp_path, source)
    rows, made_by = read(tmp_path)
    assert [row["stage"] for row in rows] == ["exact goal"] * 2 + ["camera goal"] * 2
    assert [row["not_seen"] for row in rows] == [0.0] * 2 + [0.5] * 2
    assert [row["success_rate"] for row in rows] == [1.0] * 2 + [0.5] * 2
    assert [row["achieved_rate"] for row in rows] == [1.0] * 2 + [0.5] * 2
    assert all(0.0 < row["distance_l2"] < 0.05 for row in rows)
    assert list(made_by) == [
        f"{source} goal: {GymnasiumFetch.name}: {task}" for source in ("exact", "camera") for task in ("reach", "grasp")
    ]


class Crane(Robot):
    """Moves a point as far as the Fetch's gripper moves; holds nothing."""

    name = "Crane, no simulator"
    extra = "crane"
    packages = ("no-such-package",)
    curves = (OptionCurve("reel", "length of the rope (m)", "wet", "reach", option="rope", values=(1.0, 2.0)),)
    slowdown = 2
    offset = np.zeros(3)

    cube = "cube"
    model = mujoco.MjModel.from_xml_string("<mujoco/>")

    def __init__(self, task, rope=1.0):
        self.task = task

    @classmethod
    def variants(cls, task):
        return [{}, {"rope": 2.0}] if task == "reach" else [{}]

    def reset(self, rng):
        self.position, self.velocity = np.array([1.34, 0.75, 0.53]), np.zeros(3)
        self.goal = self.position + rng.uniform(-0.1, 0.1, 3)

    def features(self):
        return np.concatenate([self.position, self.velocity, np.zeros(2 if self.task == "grasp" else 0)])

    def target(self):
        return self.goal

    def step(self, action):
        self.velocity = 0.033 * action[:3]
        self.position = self.position + self.velocity


def one_of_each(policies):
    """Returns one policy of each task: reading eight for each point takes seconds."""
    return {label: {task: paths[:1] for task, paths in of.items()} for label, of in policies.items()}


def test_a_robot_is_added_by_one_entry(tmp_path, monkeypatch, shipped_policy, few_values):
    """The table has its variants, the sweep its own curve and the quantities, and the files its packages."""
    for robot in list(ROBOTS):
        monkeypatch.delitem(ROBOTS, robot)
    monkeypatch.setitem(ROBOTS, "crane", Crane)
    write_table(tmp_path, ["exact"], ["crane"], ["reach", "grasp"], episodes=2, seed=0, workers=1)
    rows, _ = read(tmp_path)
    assert [row["task"] for row in rows] == ["reach", "reach", "grasp"]
    assert {(row["robot"], row["milliseconds_per_action"]) for row in rows} == {("Crane, no simulator", 80)}
    assert [row["success_rate"] for row in rows] == [1.0, 1.0, 0.0]
    policies = one_of_each(find_policies(["reach", "grasp"], [f"other={shipped_policy}"]))
    write_sweep(tmp_path, policies, ["crane"], ["reach", "grasp", "slide"], episodes=1, seed=0, workers=1)
    rows, made_by = read(tmp_path, "transfer-sweep")
    plain, other = ([row for row in rows if row["policy"] == label] for label in ("plain", "other"))
    assert len(plain) + len(other) == len(rows)
    assert [row["quantity"] for row in plain][:2] == ["reel, wet"] * 2
    on_robots = {name for name, quantity in QUANTITIES.items() if quantity.conditions}
    assert {row["quantity"] for row in plain[2:]} == on_robots
    assert {row["quantity"] for row in other[2:]} == on_robots - {"mass"}  # a policy of reach has no object
    assert set(made_by) == {"Crane, no simulator: reach", "Crane, no simulator: grasp"}  # it cannot slide
    assert made_by["Crane, no simulator: grasp"]["versions"]["no-such-package"] is None
    assert imageio.imread(tmp_path / "transfer-sweep-crane.png").std() > 10


def test_rows_of_another_task_stay(tmp_path, monkeypatch):
    for robot in list(ROBOTS):
        monkeypatch.delitem(ROBOTS, robot)
    monkeypatch.setitem(ROBOTS, "crane", Crane)
    for seed, tasks in enumerate([["reach", "grasp"], ["grasp"]]):
        write_table(tmp_path, ["exact"], ["crane"], tasks, episodes=1, seed=seed, workers=1)
    rows, made_by = read(tmp_path)
    assert [row["task"] for row in rows] == ["reach", "reach", "grasp"]
    assert {name.split(": ")[-1]: made["seed"] for name, made in made_by.items()} == {"reach": 0, "grasp": 1}


@pytest.fixture
def few_values(monkeypatch):
    """Has sweeps measure two values of each quantity."""
    for name, quantity in QUANTITIES.items():
        monkeypatch.setitem(QUANTITIES, name, dataclasses.replace(quantity, values=quantity.values[:2]))


def test_curves_of_another_task_stay(tmp_path, monkeypatch, few_values):
    for robot in list(ROBOTS):
        monkeypatch.delitem(ROBOTS, robot)
    monkeypatch.setitem(ROBOTS, "crane", Crane)
    drawn = {}
    monkeypatch.setattr(results, "draw_sweep", lambda path, *of_figure: drawn.update({path.stem: of_figure}))
    policies = one_of_each(find_policies(["reach", "grasp"]))
    for seed, task in enumerate(["reach", "grasp", "grasp"]):
        write_sweep(tmp_path, policies, ["crane"], [task], episodes=1, seed=seed, workers=1)
        if task == "reach":
            of_reach, _ = read(tmp_path, "transfer-sweep")
    rows, made_by = read(tmp_path, "transfer-sweep")
    assert [row for row in rows if row["task"] == "reach"] == of_reach
    assert [row["task"] for row in rows].count("grasp") == len(rows) - len(of_reach) > 0
    assert len({(row["task"], row["quantity"], row["value"]) for row in rows}) == len(rows)  # none is there twice
    assert {name: of_figure[0] for name, of_figure in drawn.items()} == {"transfer-sweep-crane": rows}
    assert {name: made["seed"] for name, made in made_by.items()} == {
        "Crane, no simulator: reach": 0,
        "Crane, no simulator: grasp": 2,
    }


ROW = {"robot": "A, b", "task": "reach", "policy": "plain", "quantity": "noise", "value": 0.0, "success_rate": 0.5}
ROW |= {"success_low": 0.4, "success_high": 0.6}
AXES = {"noise": "noise (m)", "speed": "speed (m/s)"}
POLICIES = ["plain", "other arms", "robust"]


@pytest.mark.parametrize("second", [{"policy": "robust"}, {"quantity": "speed, fast"}, {"task": "grasp"}])
def test_curves_have_an_ink_for_each_line(tmp_path, second):
    """A second policy's line, and a line in another panel or of another task, each change the picture."""
    pictures = []
    for drawn in ([ROW], [ROW, ROW | {"success_rate": 0.2, "success_low": 0.1} | second]):
        draw_sweep(tmp_path / "curves.png", drawn, AXES, POLICIES)
        pictures.append(imageio.imread(tmp_path / "curves.png"))
    assert pictures[0].shape != pictures[1].shape or (pictures[0] != pictures[1]).any()
    assert list(tmp_path.iterdir()) == [tmp_path / "curves.png"]


def inks(path):
    """Returns which of matplotlib's first three colours a picture has, by name."""
    pixels = imageio.imread(path)[..., :3]
    inks = {name: np.round(255 * np.array(colors.to_rgb(name))) for name in ("C0", "C1", "C2")}
    return [name for name, ink in inks.items() if (pixels == ink).all(axis=-1).any()]


def test_a_policy_has_its_colour_in_each_figure(tmp_path):
    apart = {"success_rate": 0.2, "success_low": 0.1, "success_high": 0.3}
    for others, wanted in ((["other arms", "robust"], ["C0", "C1", "C2"]), (["robust"], ["C0", "C2"])):
        rows = [ROW, *(ROW | apart | {"policy": policy} for policy in others)]
        draw_sweep(tmp_path / "curves.png", rows, AXES, POLICIES)
        assert inks(tmp_path / "curves.png") == wanted


def test_equal_curves_do_not_hide_one_another(tmp_path):
    policies = [*POLICIES, "script"]
    rows = [ROW | {"policy": policy, "value": value} for policy in policies for value in (0.0, 1.0)]
    draw_sweep(tmp_path / "curves.png", rows, AXES, policies)
    pixels = imageio.imread(tmp_path / "curves.png")[:210, 80:340, :3]  # within the first panel, between the points
    for name in ("C0", "C1", "C2", "C3"):
        off = np.abs(pixels - 255 * np.array(colors.to_rgb(name))).max(axis=-1)  # a thin line's ink is a little off
        assert (off < 40).sum() > 20, name

"""hgail evaluate and hgail export."""

import dataclasses
import importlib.util
import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy import stats

import hgail_envs
from experiments.transfer.episode import run_episodes
from experiments.transfer.robots import GymnasiumFetch
from hgail_envs.base import EpisodeMetrics
from hgail_envs.randomization import LEVELS
from hgail_envs.randomized import randomize
from hgail_envs.vision.pictures import KINDS
from hgail_envs.vision.rendering import RenderingError
from hgail_jax import load_policy, save_policy
from hgail_jax.cli import evaluate, export, play
from hgail_jax.cli.policies import make_task
from hgail_jax.play.evaluation import Evaluation
from hgail_jax.trainer.statistics import success_interval
from hgail_jax.vision.network import init_eyes
from hgail_jax.vision.policy import CameraPolicy
from tests.support import refused


@pytest.fixture
def run_folder(tmp_path, shipped_policy):
    folder = tmp_path / "run"
    (folder / "policies").mkdir(parents=True)
    for seed in (10, 9):
        shutil.copy(shipped_policy, folder / "policies" / f"seed-{seed}.npz")
    (folder / "summary.json").write_text(json.dumps({"success_rate": {"per_seed": [0.25, 0.75]}}))
    return folder


def report(arguments, capsys):
    evaluate.main([*arguments, "--json"])
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(("hits", "episodes"), [(0, 5), (5, 5), (3, 7), (180, 200)])
def test_the_interval_is_wilson_s(hits, episodes):
    low, high = stats.binomtest(hits, episodes).proportion_ci(method="wilson")
    assert success_interval(hits / episodes, episodes) == pytest.approx((hits / episodes, low, high))


def test_what_is_printed_is_what_a_roll_out_of_the_policy_gives(capsys, shipped_policy):
    shown = report(["--task", "reach", "--episodes", "6", "--seed", "3"], capsys)
    (row,) = shown["policies"]
    policy = load_policy(shipped_policy)
    env = hgail_envs.make("reach")
    step, reset = jax.jit(env.step), jax.jit(env.reset)
    (rng,) = jax.random.split(jax.random.key(3), 1)  # one roll-out
    distances = []
    for key in jax.random.split(jax.random.split(rng)[0], 6):
        state = reset(key)
        for _ in range(env.episode_length):
            state = step(state, policy(np.asarray(state.obs)))
        distances.append(np.linalg.norm(state.info["achieved_goal"] - state.info["desired_goal"]))
    assert row["distance_l2"] == pytest.approx(np.mean(distances), abs=1e-4)
    assert row["success"] == np.mean(np.array(distances) <= 0.05)
    assert (shown["task"], shown["engine"], row["episodes"]) == ("reach", env.impl, 6)


def test_seeds_of_a_run_are_measured_one_by_one(capsys, run_folder):
    shown = report(["--policy", str(run_folder), "--episodes", "3"], capsys)
    assert [row["policy"].split("/")[-1] for row in shown["policies"]] == ["seed-9.npz", "seed-10.npz"]
    success = shown["policies"][0]["success"]
    assert success == shown["policies"][1]["success"]
    assert shown["mean"] == {"success": success}  # two have no interval


def test_policies_are_measured_where_asked_for_and_three_have_an_interval(
    capsys, tmp_path, monkeypatch, shipped_policy
):
    tasks = []

    class Measured:
        def __init__(self, env, seed, episodes):
            tasks.append((env.randomization, seed))
            self.episodes, self.coming = episodes, iter((0.5, 0.6, 0.7))

        def __call__(self, policy):
            return EpisodeMetrics(success=next(self.coming))

    monkeypatch.setattr(evaluate, "Evaluation", Measured)
    for seed in (1, 2, 3):
        shutil.copy(shipped_policy, tmp_path / f"seed-{seed}.npz")
    evaluate.main(["--policy", str(tmp_path), "--episodes", "10", "--randomize", "mild", "--seed", "7"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 7 and tasks == [(LEVELS["mild"], 7)]
    assert "randomised: mild (trained without), engine" in lines[0]
    assert [line.split()[1] for line in lines[1:6:2]] == ["0.500", "0.600", "0.700"]
    assert lines[-1] == "mean of 3 seeds: success 0.600 [0.352, 0.848], interval over seeds"


def test_policies_that_share_a_program_act_each_by_its_own_weights(capsys, tmp_path, shipped_policy):
    good = load_policy(shipped_policy)
    *hidden, (weights, biases) = good.layers
    still = dataclasses.replace(good, layers=(*hidden, (0 * weights, 0 * biases)))
    for name, policy in {"seed-0": good, "seed-1": still, "seed-2": good}.items():
        save_policy(tmp_path / f"{name}.npz", policy)
    shown = report(["--policy", str(tmp_path), "--episodes", "20"], capsys)
    success = [row["success"] for row in shown["policies"]]
    assert success[0] == success[2] == 1.0
    assert success[1] < 0.3  # of a target that is at the gripper already
    assert 0.0 <= shown["mean"]["low"] < shown["mean"]["success"] < shown["mean"]["high"] == 1.0  # Student's is beyond


@pytest.fixture
def policy_of_franka(shipped_policy, tmp_path):
    pytest.importorskip("gymnasium_robotics")
    policy = dataclasses.replace(load_policy(shipped_policy), task_options={"robot": "franka"})
    save_policy(tmp_path / "p.npz", policy)
    return policy


def test_a_task_has_the_robot_of_its_policy_s_training_unless_another_is_named(tmp_path, policy_of_franka):
    env = make_task(load_policy(tmp_path / "p.npz"), "reach", None)
    assert env.robot.name == randomize(env, "mild").robot.name == "franka"
    named = make_task(load_policy(tmp_path / "p.npz"), "reach", None, robot="fetch")
    assert named.robot.name == "fetch"


@pytest.mark.slow
def test_a_policy_acts_on_the_robot_of_its_training_unless_another_is_named(tmp_path, capsys, policy_of_franka):
    for robot, named in (("franka", []), ("fetch", ["--robot", "fetch"])):
        (row,) = report(["--policy", str(tmp_path / "p.npz"), "--episodes", "4", *named], capsys)["policies"]
        expected = Evaluation(hgail_envs.make("reach", robot=robot), 0, 4)(policy_of_franka)
        assert row["distance_l2"] == pytest.approx(float(expected.distance_l2), abs=1e-6)


def test_distances_that_no_episode_has_are_null():
    broken = EpisodeMetrics(success=0.0, achieved=0.0, success_l1=0.0, distance_l1=np.inf, distance_l2=np.inf)
    row = evaluate._row(Path("broken.npz"), broken, 5)
    assert row["distance_l1"] is row["distance_l2"] is None
    assert evaluate._text(row) == "success 0.000 [0.000, 0.434] in 5 episodes"


@pytest.mark.parametrize(
    ("task", "name"),
    [("push", "push"), ("grasp", "grasp-robust"), pytest.param("grasp", "grasp", marks=pytest.mark.slow)],
)
def test_the_reference_s_episodes_are_those_of_the_transfer_study(task, name, capsys):
    pytest.importorskip("gymnasium_robotics")
    path = hgail_envs.scenes.assets_directory() / "policies" / f"{name}.npz"
    chosen = ["--task", task] if name == task else ["--policy", str(path)]
    (row,) = report([*chosen, "--reference", "--episodes", "3", "--seed", "5"], capsys)["policies"]
    policy = load_policy(path)
    ends = run_episodes(GymnasiumFetch(task), [policy], range(3), seed=5)
    for name in ("success", "achieved", "distance_l1", "distance_l2"):
        assert row[name] == pytest.approx(np.mean([getattr(end, name) for end in ends]), abs=1e-9)


def test_the_reference_shows_a_policy_of_a_tracked_cube_where_it_is(tmp_path, capsys, tracking_policy):
    pytest.importorskip("gymnasium_robotics")
    save_policy(tmp_path / "p.npz", tracking_policy)
    (row,) = report(["--policy", str(tmp_path / "p.npz"), "--reference", "--episodes", "2"], capsys)["policies"]
    ends = run_episodes(GymnasiumFetch("grasp"), [tracking_policy], range(2), seed=0)
    assert row["distance_l1"] == pytest.approx(np.mean([end.distance_l1 for end in ends]), abs=1e-9)


@pytest.mark.parametrize(("goal_size", "kind"), [(4, "colour"), (0, "colour"), (4, "depth")])
def test_a_policy_of_pictures_sees_the_reference_s_scene_and_its_own_numbers(
    goal_size, kind, tmp_path, capsys, monkeypatch, rendering
):
    pytest.importorskip("gymnasium_robotics")
    save_policy(tmp_path / "p.npz", blind_policy(goal_size, kind))
    given = []

    def stand_still(policy, pictures, numbers):
        given.append((pictures, numbers))
        return np.zeros(4, np.float32)

    monkeypatch.setattr(CameraPolicy, "__call__", stand_still)
    (row,) = report(["--policy", str(tmp_path / "p.npz"), "--reference", "--episodes", "1"], capsys)["policies"]
    assert len(given) == 50
    pictures, numbers = (np.stack(column) for column in zip(*given, strict=True))
    assert pictures.shape == (50, 1, 16, 16, KINDS[kind]) and pictures.dtype == np.uint8 and pictures.std() > 10.0
    ends = run_episodes(GymnasiumFetch("push"), [lambda _: np.zeros(4)], range(1), seed=0)
    np.testing.assert_allclose(numbers[:, :3].std(axis=0), 0.0, atol=1e-2)  # the hand, which stands still
    assert numbers.shape[1] == 6 + goal_size
    assert row["distance_l1"] == pytest.approx(np.mean([end.distance_l1 for end in ends]), abs=1e-6)


@pytest.mark.parametrize(
    "kind", ["colour", *(pytest.param(kind, marks=pytest.mark.slow) for kind in {*KINDS} - {"colour"})]
)
def test_look_and_renderer_of_a_policy_of_pictures_are_said(kind, tmp_path, capsys, monkeypatch, rendering):
    monkeypatch.setattr(hgail_envs.find_class("push"), "episode_length", 2)
    save_policy(tmp_path / "p.npz", dataclasses.replace(blind_policy(4, kind), look="varied"))
    words = ["--policy", str(tmp_path / "p.npz"), "--episodes", "1"]
    shown = report(words, capsys)
    assert (shown["look"], shown["renderer"]) == ("plain", "opengl")
    evaluate.main(words)
    assert capsys.readouterr().out.splitlines()[0].endswith(f"engine {shown['engine']}, look plain, renderer opengl")


@pytest.mark.parametrize(
    ("command", "words"), [(evaluate, []), (export, ["--out", "p.onnx"]), (play, ["--out", "p.mp4"])]
)
def test_where_mujoco_cannot_render_commands_say_so_in_one_line(command, words, tmp_path, capsys, monkeypatch):
    def fail(*_):
        raise RenderingError("MuJoCo cannot render here")

    monkeypatch.setattr("hgail_envs.vision.opengl.open_renderer", fail)
    save_policy(tmp_path / "p.npz", blind_policy(4))
    with pytest.raises(SystemExit) as ended:
        command.main(["--policy", str(tmp_path / "p.npz"), *words])
    assert ended.value.code == 2
    assert capsys.readouterr().err.endswith("MuJoCo cannot render here\n")


@pytest.mark.parametrize(
    ("goal_size", "task", "message"),
    [
        (4, "stack", "the policy takes 10 numbers; in stack there are 13"),
        (0, "reach", "the policy predicts the objects' positions in 6 numbers; in reach there are 3"),
        (4, "point", "the task has no scene that a camera could see"),
    ],
)
def test_a_policy_of_pictures_for_another_task_is_refused(goal_size, task, message, tmp_path, capsys, rendering):
    save_policy(tmp_path / "p.npz", blind_policy(goal_size))
    refused(evaluate.main, ["--policy", str(tmp_path / "p.npz"), "--task", task], message, capsys)


def blind_policy(goal_size, kind="colour"):
    outputs = 4, 3 if goal_size else 6
    eyes = init_eyes(jax.random.key(0), 1, 6 + goal_size, (4, 4, 4, 4), (8,), outputs, KINDS[kind])
    ones, centre = np.ones(6 + goal_size, np.float32), np.ones(3 if goal_size else 6, np.float32)
    eyes = jax.tree.map(np.asarray, eyes)
    return CameraPolicy("push", goal_size, ("side",), 16, ones, ones, centre, eyes, kind=kind)


@pytest.mark.slow
def test_the_reference_of_an_arm_is_its_full_model(tmp_path, capsys, shipped_policy):
    """With --robot of a policy of the Fetch, without it of one that was trained on the arm."""
    pytest.importorskip("gymnasium_robotics")
    policy = load_policy(shipped_policy)
    env = hgail_envs.make("reach", robot="franka", impl="reference")
    expected = Evaluation(env, 0, 4)(policy)
    for options, named in (({}, ["--robot", "franka"]), ({"robot": "franka"}, [])):
        save_policy(tmp_path / "p.npz", dataclasses.replace(policy, task_options=options))
        found = report(["--policy", str(tmp_path / "p.npz"), "--episodes", "4", "--reference", *named], capsys)
        assert found["policies"][0]["distance_l2"] == pytest.approx(float(expected.distance_l2), abs=1e-6)
        assert found["engine"] == "reference"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--episodes", "0"], "episodes is 0; it must be at least 1"),
        (["--seed", "-1"], "seed is -1"),
        (["--task", "poke"], "unknown task 'poke'"),
        (["--policy", "none.npz"], "there is no file or folder none.npz"),
        (
            ["--policy", "stopped"],
            "stopped has no policies until the run ends; resume it with its options and --resume stopped",
        ),
        (["--policy", "ended"], "ended does not hold a policy: it is no regular file, nor a run's folder"),
        (["--policy", "text.md"], "text.md does not hold a policy: File is not a zip file"),
        (["--policy", "."], ". does not hold a policy: it is no regular file, nor a run's folder"),
        (["--impl", "fast"], "impl is 'fast'; choose from auto, warp, c, jax"),
        (["--randomize", "wild"], "randomize is 'wild'"),
        (["--task", "point"], "no policy of point comes with the package"),
        (["--reference", "--impl", "c"], "leave out --impl"),
        (["--policy", "small.npz", "--task", "push"], "the policy reads 9 numbers; observations of push have 19"),
        (["--policy", "small.npz", "--reference"], "the policy reads 9 numbers; observations of push have 19"),
        (["--reference", "--randomize", "mild"], "leave out --impl and --randomize"),
        (["--robot", "panda"], "robot is 'panda'; choose from fetch, franka"),
    ],
)
def test_bad_input_to_evaluate_is_one_line(arguments, message, capsys, tmp_path, monkeypatch, shipped_policy):
    for run in {"stopped", "ended"} & set(arguments):  # one has no policies as yet, of the other they are lost
        (tmp_path / run).mkdir()
        (tmp_path / run / "config.json").write_text("{}")
    if "ended" in arguments:
        (tmp_path / "ended" / "summary.json").write_text("{}")
    if "text.md" in arguments:
        (tmp_path / "text.md").write_text("# Title")
    if "small.npz" in arguments:
        save_policy(tmp_path / "small.npz", dataclasses.replace(load_policy(shipped_policy), task="push"))
    refused_in(evaluate.main, arguments, message, capsys, tmp_path, monkeypatch)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--out", "p.txt"], "it must end in .onnx, .mlirbc, .npz"),
        (["--task", "poke"], "unknown task 'poke'"),
        (["--policy", "none.npz"], "there is no file or folder none.npz"),
        (["--policy", "run", "--out", "p.npz"], "run has 2 policies; name one, e.g. run/policies/seed-9.npz"),
        (["--out", "run/summary.json/p.npz"], "Not a directory"),
        (["--out", "run/policies/seed-9.npz"], "exists already"),
        (["--randomize", "wild"], "randomize is 'wild'"),
        (["--randomize", "full", "--policy", "run"], "leave out --policy"),
        (
            ["--task", "push", "--randomize", "full"],
            "no policy of push for --randomize full comes with the package; name one",
        ),
        *(
            (["--task", "reach", "--randomize", level], f"no policy of reach for --randomize {level} comes with")
            for level in ("other-arms", "full-known-delay")  # which the robust policy was not trained under
        ),
        (["--task", "push", "--policy", "run/policies/seed-9.npz", "--out", "p.npz"], "for 'reach', not for 'push'"),
        (["--episodes", "-1"], "episodes is -1"),
        (["--policy", "odd.npz", "--out", "new/folder/p.onnx"], "which is no observation of push"),
        (
            ["--policy", "official.npz", "--episodes", "0"],
            "task 'reach' has no option 'observation'; it takes impl, substeps, worlds",
        ),
    ],
)
def test_bad_input_to_export_is_one_line(arguments, message, capsys, tmp_path, monkeypatch, run_folder, shipped_policy):
    policy = load_policy(shipped_policy)
    save_policy(tmp_path / "odd.npz", dataclasses.replace(policy, task="push"))
    save_policy(tmp_path / "official.npz", dataclasses.replace(policy, task_options={"observation": "official"}))
    refused_in(export.main, arguments, message, capsys, tmp_path, monkeypatch)


def refused_in(program, arguments, message, capsys, folder, monkeypatch):
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    refused(program, arguments, message, capsys)
    assert sorted(folder.rglob("*")) == before


def test_onnx_without_its_package_is_refused_before_anything_is_written(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    refused_in(export.main, ["--task", "reach"], "pip install 'hgail-jax[onnx]'", capsys, tmp_path, monkeypatch)


@pytest.mark.parametrize(
    ("level", "name"),
    [("other-arms", "grasp-other-arms"), ("full", "grasp-robust"), ("none", "grasp"), (None, "grasp")],
)
def test_the_policy_that_was_trained_under_a_level_is_exported(level, name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    export.main(["--task", "grasp", "--out", "p.npz", *(["--randomize", level] if level else [])])
    written, expected = (
        load_policy(path) for path in ("p.npz", hgail_envs.scenes.assets_directory() / "policies" / f"{name}.npz")
    )
    assert (written.randomization, written.task_options) == (expected.randomization, expected.task_options)
    observation = np.random.default_rng(0).normal(size=(5, expected.observation_size)).astype(np.float32)
    np.testing.assert_array_equal(written(observation), expected(observation))


def test_a_policy_is_exported_in_each_format(capsys, tmp_path, monkeypatch, run_folder):
    monkeypatch.chdir(tmp_path)
    for name in ("p.npz", "p.mlirbc"):
        export.main(["--task", "reach", "--out", name])
        assert capsys.readouterr().out.endswith(f"-> {name}\n")
    observation = np.random.default_rng(0).normal(size=(5, 9)).astype(np.float32)
    shipped = load_policy(hgail_envs.scenes.assets_directory() / "policies" / "reach.npz")
    np.testing.assert_array_equal(load_policy("p.npz")(observation), shipped(observation))
    onnx = pytest.importorskip("onnx")
    export.main(["--policy", "run/policies/seed-10.npz"])
    metadata = {each.key: each.value for each in onnx.load("reach.onnx").metadata_props}
    assert float(metadata["success"]) == 0.75  # of the second seed, as the run measured it
    for episodes, success in (("3", "1.0"), ("0", None)):
        export.main(["--task", "reach", "--out", f"{episodes}.onnx", "--episodes", episodes])
        metadata = {each.key: each.value for each in onnx.load(f"{episodes}.onnx").metadata_props}
        assert metadata.get("success") == success

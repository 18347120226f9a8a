"""Runs that see pictures: resumed, written and read again, and refused in one line."""

import copy
import dataclasses
import functools
import hashlib
import json
import shutil
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hgail_envs
from hgail_envs.scenes import assets_directory
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.look import LOOKS
from hgail_jax import init_state, load_policy
from hgail_jax.cli import train as command
from hgail_jax.io.files import load_npz, save_npz
from hgail_jax.io.policy import from_state, load_any_policy, save_policy
from hgail_jax.settings.defaults import task_preset
from hgail_jax.trainer import camera
from hgail_jax.trainer.checkpoint import AnotherRunError, as_json, refuse_another_run
from hgail_jax.trainer.train_options import TrainOptions
from hgail_jax.trainer.training import Trainer
from hgail_jax.vision.augmentation import AUGMENTATIONS, Augmentation
from hgail_jax.vision.network import look
from hgail_jax.vision.policy import CameraPolicy, sizes_of_look
from tests.hgail_jax.trainer.stand_in import train_without_a_compiler
from tests.hgail_jax.trainer.test_checkpoint import saved_in
from tests.hgail_jax.trainer.test_trainer import After
from tests.hgail_jax.vision.scenes import Map
from tests.support import make_runs_tiny, refused

TEACHER = assets_directory() / "policies" / "push.npz"
OPTIONS = {"task": "push", "observe": "camera", "teacher": TEACHER, "seeds": 2, "num_envs": 2, "rounds": 2}
TAUGHT = ["--task", "push", "--observe", "camera", "--teacher", str(TEACHER)]
OPTIONS |= {"updates": 2, "batch": 8, "evaluation_episodes": 2, "channels": (4, 4, 4, 4), "policy_hidden": (8,)}


@pytest.fixture(autouse=True)
def seen_from_above(monkeypatch, tmp_path):
    """Has runs draw their pictures instead of rendering them."""
    monkeypatch.setattr(camera, "Pictures", lambda env, *_: Map(env))
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of three rounds, and one that was stopped after its first."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(camera, "Pictures", lambda env, *_: Map(env))
        train_without_a_compiler(patch)
        whole, stopped = (Trainer(**OPTIONS, out=tmp_path_factory.mktemp("runs") / name) for name in ("whole", "parts"))
        whole.train()
        stopped.train(After(3))
        assert saved_in(stopped.folder) == [1]
        stopped = Trainer(**OPTIONS, resume=stopped.folder)
        stopped.train()
        return whole, stopped


def opened(path):
    """Returns the header and the arrays of a policy's file."""
    kind = "hgail_jax camera policy 1"
    header, arrays = load_npz(path, "it", {kind: lambda header, arrays: (header, {n: arrays[n] for n in arrays})})
    arrays.pop("header")
    return header, arrays


def test_a_resumed_run_ends_with_the_bits_of_one_that_was_not_stopped(trained):
    for seed in range(2):
        one, other = (run.folder / "policies" / f"seed-{seed}.npz" for run in trained)
        with np.load(one) as ours, np.load(other) as theirs:
            for name in set(ours) - {"header"}:
                np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)


def test_the_folder_keeps_the_teacher_and_names_it(trained):
    kept = trained[0].folder / "teacher.npz"
    assert kept.read_bytes() == TEACHER.read_bytes()
    pictures = trained[0].run.identity()["physics"]["pictures"]
    assert pictures == {
        "cameras": ["above"],
        "size": 16,
        "look": "plain",
        "look_sizes": {"scene": dataclasses.asdict(LOOKS["plain"]), "image": dataclasses.asdict(Augmentation())},
        "renderer": "map",
        "target": "given",
        "teacher": hashlib.sha256(TEACHER.read_bytes()).hexdigest(),
    }


def test_a_run_of_a_look_of_other_sizes_is_another_and_one_without_them_is_not(trained):
    here = trained[0].run.identity()
    other, older = copy.deepcopy(here), copy.deepcopy(here)
    other["physics"]["pictures"]["look_sizes"]["scene"]["shadows"] = 0.25
    with pytest.raises(AnotherRunError, match=r"look_sizes.scene.shadows is 0.25 there and 1.0 here"):
        refuse_another_run("folder", as_json(other), here)
    del older["physics"]["pictures"]["look_sizes"]["image"]["blur"]
    refuse_another_run("folder", as_json(older), here)  # from before there was blur, of which this look has none
    blurred = copy.deepcopy(here)
    blurred["physics"]["pictures"]["look_sizes"]["image"]["blur"] = 1.0
    with pytest.raises(AnotherRunError, match=r"look_sizes.image.blur is absent there and 1.0 here"):
        refuse_another_run("folder", as_json(older), blurred)
    del older["physics"]["pictures"]["look_sizes"]
    refuse_another_run("folder", as_json(older), here)


def test_an_older_file_of_a_policy_has_no_sizes_of_its_look(trained, tmp_path):
    path = trained[0].folder / "policies" / "seed-0.npz"
    header, arrays = opened(path)
    assert header.pop("look_sizes") == load_any_policy(path).look_sizes == sizes_of_look("plain", "colour")
    save_npz(tmp_path / "older.npz", header, arrays)
    assert load_any_policy(tmp_path / "older.npz").look_sizes == {}


def test_a_policys_file_holds_all_of_it(trained, tmp_path):
    policy = trained[0].policy(0)
    assert isinstance(policy, CameraPolicy)
    save_policy(tmp_path / "again.npz", policy)
    again = load_any_policy(tmp_path / "again.npz")
    for field in dataclasses.fields(CameraPolicy):
        one, other = (getattr(each, field.name) for each in (policy, again))
        jax.tree.map(np.testing.assert_array_equal, one, other)


def test_a_policy_that_sees_the_target_is_printed_no_goal(trained, tmp_path):
    run = trained[0].run
    env = CameraEnv(run.env.task, Map(run.env.task, "seen"), run.env.teacher)
    state = init_state(env, run.config, run.hyperparameters, jax.random.key(0))
    save_policy(tmp_path / "policy.npz", from_state("push", env, run.config, state))
    policy = load_any_policy(tmp_path / "policy.npz")
    assert (policy.target, policy.goal_size, policy.mean.size) == ("seen", 0, trained[0].policy(0).mean.size - 4)


def test_a_policy_of_depth_is_written_and_read_as_one(trained, tmp_path):
    run, path = trained[0].run, tmp_path / "policy.npz"
    pictures = Map(run.env.task, kind="depth")
    pictures.look = "varied"
    env = CameraEnv(run.env.task, pictures, run.env.teacher)
    state = init_state(env, run.config, run.hyperparameters, jax.random.key(0))
    save_policy(path, from_state("push", env, run.config, state))
    policy = load_any_policy(path)
    assert (policy.kind, policy.pictures_shape) == ("depth", (1, 16, 16, 1))
    assert policy.look_sizes["image"] == dataclasses.asdict(AUGMENTATIONS["depth"]["varied"])
    header, arrays = opened(path)
    assert header["pictures"] == {
        "cameras": ["above"],
        "size": 16,
        "kind": "depth",
        "range": [0, 255],
        "metres": [0.0, 1.6],
    }
    assert arrays["kernel_0"].shape[2] == 1
    assert policy(np.zeros((1, 16, 16, 1), np.uint8), np.zeros(10)).shape == (4,)
    with pytest.raises(ValueError, match=r"the policy sees \(1, 16, 16, 1\): above, 16 x 16, depth"):
        policy(np.zeros((1, 16, 16, 3), np.uint8), np.zeros(10))
    identity = dataclasses.replace(run, env=env).identity()
    here = as_json(run.identity())
    for one, other, said in ((here, identity, "absent there and depth"), (as_json(identity), here, "depth there and")):
        with pytest.raises(AnotherRunError, match=f"physics.pictures.kind is {said}"):
            refuse_another_run("folder", one, other)
    for wrong in ({"metres": [0.0, 4.0]}, {"kind": "heat"}, {"kind": "colour", "colours": "RGB"}):
        save_npz(path, header | {"pictures": header["pictures"] | wrong}, arrays)
        with pytest.raises(ValueError, match="does not hold a policy"):
            load_any_policy(path)


def test_a_file_from_before_there_was_depth_is_of_colours_and_written_again_the_same(tmp_path):
    before = TEACHER.with_name("push-camera.npz")
    policy = load_any_policy(before)
    save_policy(tmp_path / "again.npz", policy)
    assert policy.kind == "colour" and policy.pictures_shape == (2, 64, 64, 3)
    assert (tmp_path / "again.npz").read_bytes() == before.read_bytes()


def test_a_policy_acts_on_pictures_and_numbers(trained):
    policy, rng = trained[0].policy(0), np.random.default_rng(0)
    pictures = rng.integers(0, 256, (3, 2, 1, 16, 16, 3)).astype(np.uint8)
    numbers = rng.normal(size=(3, 2, policy.mean.size)).astype(np.float32)
    action = policy(pictures, numbers)
    assert action.shape == (3, 2, 4)
    normal = jnp.asarray((numbers[1, 1] - policy.mean) / policy.std)[None]
    expected, _ = look(policy.eyes, jnp.asarray(pictures[1, 1], jnp.float32)[None] / 255.0, normal)
    np.testing.assert_allclose(action[1, 1], expected[0], atol=1e-5)
    np.testing.assert_array_equal(policy([*pictures], numbers.tolist()), action)


def test_other_pictures_and_numbers_are_refused(trained):
    policy = trained[0].policy(0)
    pictures, numbers = np.zeros((1, 16, 16, 3), np.uint8), np.zeros(policy.mean.size)
    for wrong, message in (
        ((pictures[:, :8], numbers), r"shape \(1, 8, 16, 3\); the policy sees \(1, 16, 16, 3\): above, 16 x 16"),
        ((pictures / 255.0, numbers), "pictures are float64; they must be uint8, from 0 to 255"),
        ((pictures.tolist(), numbers), "pictures are int64; they must be uint8, from 0 to 255"),
        ((pictures, numbers[1:]), "the policy takes 10 numbers beside the pictures"),
        (([pictures] * 3, [numbers] * 2), r"a batch of pictures is \(3,\), and that of numbers \(2,\)"),
        (([pictures], numbers), r"a batch of pictures is \(1,\), and that of numbers \(\)"),
        ((pictures, [*numbers[1:], np.nan]), "not all of the numbers beside the pictures are finite"),
    ):
        with pytest.raises(ValueError, match=message):
            policy(*wrong)


def test_a_policy_of_pictures_is_refused_where_positions_are_given(trained):
    path = trained[0].folder / "policies" / "seed-0.npz"
    with pytest.raises(ValueError, match="sees pictures; here a policy is given positions"):
        load_policy(path)


@pytest.mark.parametrize("fault", ["nan", "kernel_biases_0", "cameras"])
def test_a_damaged_file_is_refused(trained, tmp_path, fault):
    header, arrays = opened(trained[0].folder / "policies" / "seed-0.npz")
    if fault == "nan":
        arrays["weights_0"] = arrays["weights_0"] * np.float32("nan")
    elif fault == "cameras":
        header["pictures"]["cameras"] = ["above", "below"]
    else:
        arrays[fault] = arrays[fault][:2]
    save_npz(tmp_path / "damaged.npz", header, arrays)
    with pytest.raises(ValueError, match="does not hold a policy"):
        load_any_policy(tmp_path / "damaged.npz")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--task", "push", "--camera", "front"], "--camera changes nothing without --observe camera"),
        (["--task", "push", "--target", "seen"], "--target changes nothing without --observe camera"),
        (["--task", "push", "--picture-kind", "depth"], "--picture-kind changes nothing without --observe camera"),
        (
            ["--task", "push", "--observe", "camera", "--method", "her"],
            "--method changes nothing for the method camera",
        ),
        (
            ["--task", "push", "--observe", "camera", "--randomize", "mild"],
            "--randomize changes nothing for the method camera",
        ),
        (
            ["--task", "push", "--observe", "camera", "--teacher", str(TEACHER.with_name("grasp.npz"))],
            "was trained on grasp, not on push",
        ),
        (["--task", "push", "--observe", "smell"], "smell"),
        ([*TAUGHT, "--settings", "channels=[4,4]"], "channels is (4, 4); it must be 4 numbers of features"),
        ([*TAUGHT, "--settings", "channels=[4,4,0,4]"], "a number of features in channels is 0"),
        (
            [*TAUGHT, "--settings", "policy_hidden=[]"],
            "policy_hidden is empty; a network of pictures needs a hidden layer",
        ),
        (
            [*TAUGHT, "--settings", "discriminator_batch=64"],
            "discriminator_batch changes nothing for the method camera, which has no discriminator",
        ),
        ([*TAUGHT, "--settings", "clip_ratio=0.1"], "clip_ratio changes nothing for the learner student"),
        ([*TAUGHT, "--settings", "layer_norm=true"], "layer_norm changes nothing for the learner student"),
    ],
)
def test_wrong_options_are_printed_in_one_line(words, message, capsys, tmp_path):
    refused(command.main, words, message, capsys)
    assert not list(tmp_path.iterdir())


def test_the_help_has_the_numbers_of_the_training_with_pictures(capsys):
    with pytest.raises(SystemExit):
        command.main(["--task", "push", "--observe", "camera", "--help"])
    preset = task_preset(hgail_envs.find_class("push"), "cpu", learner="student").config
    shown = " ".join(capsys.readouterr().out.split())
    assert f"The task push has --num-envs {preset.num_envs} --rounds {preset.rounds} " in shown


def test_a_training_without_a_gpu_is_refused_unless_the_renderer_is_named(monkeypatch):
    monkeypatch.setattr(camera, "Pictures", lambda env, *_: _of_opengl(Map(env)))
    options = TrainOptions(task="push", observe="camera", teacher=TEACHER)
    env = hgail_envs.make("push")
    with pytest.raises(ValueError, match="trains on an NVIDIA GPU, which is not here; --renderer opengl tries it out"):
        camera.with_camera(env, options, 1)
    camera.with_camera(env, dataclasses.replace(options, renderer="opengl"), 1)


def _of_opengl(pictures):
    pictures.renderer = "opengl"
    return pictures


@pytest.mark.parametrize("trains", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_without_a_teacher_one_is_trained_first_and_its_best_seed_teaches(
    trains, trained, monkeypatch, tmp_path, capsys
):
    make_runs_tiny(monkeypatch)
    if not trains:
        train_without_a_compiler(monkeypatch)
    options = functools.partial(_with_tiny_learner, command._teacher_options)
    monkeypatch.setattr(command, "_teacher_options", options)
    if not trains:
        monkeypatch.setattr(command, "train_run", functools.partial(_train_the_student_alone, command.train_run))
    sizes = ["--seeds", "2", "--num-envs", "2", "--rounds", "2", "--evaluation-episodes", "2"]
    sizes += ["--settings", "updates=2", "batch=8", "channels=[4,4,4,4]", "policy_hidden=[8]"]
    command.main(["--task", "push", "--observe", "camera", "--out", "student", *sizes])
    best = command._best_policy(tmp_path / "student-teacher")
    assert trains or best.name == "seed-1.npz"
    assert (tmp_path / "student" / "teacher.npz").read_bytes() == best.read_bytes()
    assert f"the teacher is {best.relative_to(tmp_path)}" in capsys.readouterr().out


def test_the_best_policy_is_of_the_first_seed_with_the_most_success(tmp_path):
    (tmp_path / "summary.json").write_text('{"success_rate": {"per_seed": [0.2, 0.9, 0.5, 0.9]}}')
    (tmp_path / "config.json").write_text('{"first_seed": 5}')
    assert command._best_policy(tmp_path) == tmp_path / "policies" / "seed-6.npz"


def _train_the_student_alone(train_run, run, folder, stop):
    """Writes what the training of a teacher leaves, whose second seed is the best; trains the student."""
    if run.teacher is not None:
        return train_run(run, folder, stop)
    policy = load_policy(TEACHER)
    (folder.path / "policies").mkdir()
    for seed in range(2):
        save_policy(folder.path / "policies" / f"seed-{seed}.npz", dataclasses.replace(policy, mean=policy.mean + seed))
    summary = SUMMARY | {"success_rate": {"mean": 0.5, "std": 0.25, "per_seed": [0.25, 0.75]}}
    for name, content in (("config", {"first_seed": 0}), ("summary", summary)):
        (folder.path / f"{name}.json").write_text(json.dumps(content))
    return summary


SUMMARY = {
    "seeds": 2,
    "distance_l1": {"mean": 0.1},
    "wall_seconds": dict.fromkeys(("compile", "train", "evaluation", "total"), 1.0),
    "env_steps_per_seed": 100,
    "env_steps_per_second": 100.0,
    "diverged_seeds": [],
}
"""Of a run's results what the command prints."""


def _with_tiny_learner(teacher_options, options, folder):
    return dataclasses.replace(teacher_options(options, folder), learner="ppo")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "there"], "there exists already; name another folder"),
        (["--resume", "nowhere"], "there is no folder nowhere to resume"),
        (["--resume", "there"], "there holds a run without a teacher, which cannot be resumed as a student's"),
        (["--settings", "policy_learning_rate=-1"], "policy_learning_rate is -1"),
        (["--settings", "policy_hidden=[]"], "policy_hidden is empty"),
    ],
)
def test_faults_are_printed_before_a_teacher_is_trained(words, message, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(command, "train_run", None)
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "config.json").write_text("{}")
    (tmp_path / "there" / "summary.json").write_text("{}")
    before = sorted(tmp_path.rglob("*"))
    refused(command.main, ["--task", "push", "--observe", "camera", *words], message, capsys)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("out", "folder"), [(["--out", "student"], "student"), ([], "runs/push-camera-1")])
def test_a_stopped_teacher_is_resumed_by_the_command_that_is_printed(out, folder, capsys, tmp_path, monkeypatch):
    make_runs_tiny(monkeypatch)
    monkeypatch.setattr(command, "_teacher_options", functools.partial(_with_tiny_learner, command._teacher_options))
    opened = []
    monkeypatch.setattr(command, "train_run", lambda run, folder, stop: opened.append(folder.path))
    words = ["--task", "push", "--observe", "camera", *out]
    for _ in range(2):
        with pytest.raises(SystemExit):
            command.main(words)
        assert capsys.readouterr().err.endswith(f"resume with: {command._command(words)}\n")
    assert opened == [Path(f"{folder}-teacher")] * 2


@pytest.mark.parametrize("named", [True, False])
def test_the_teacher_in_the_folder_that_is_resumed_is_found(trained, named, tmp_path):
    folder = tmp_path / "runs" / "push-camera-3"
    shutil.copytree(trained[0].folder, folder)
    options = {name: value for name, value in OPTIONS.items() if name != "teacher"}
    again = Trainer(**options, resume=folder if named else "auto")
    assert again.run.teacher.resolve() == folder / "teacher.npz"
    assert again.run.identity() == trained[0].run.identity()


@pytest.mark.parametrize(
    ("task", "changes", "message"),
    [
        ("slide", {}, "push.npz was trained on push, not on slide"),
        ("push", {"task_options": {"robot": "franka"}}, "was trained on the robot franka, not on fetch"),
        ("grasp", {"task": "mine:Push"}, "reads 19 numbers for 4; an observation of grasp has 12 for 4"),
    ],
)
def test_a_teacher_of_another_task_or_robot_is_refused(task, changes, message, tmp_path, monkeypatch):
    monkeypatch.setattr(camera, "Pictures", lambda env, *_: types.SimpleNamespace(renderer="map"))
    save_policy(tmp_path / "push.npz", dataclasses.replace(load_policy(TEACHER), **changes))
    options = TrainOptions(task=task, observe="camera", teacher=tmp_path / "push.npz")
    with pytest.raises(ValueError, match=message):
        camera.with_camera(hgail_envs.make(task), options, 1)


def test_pictures_are_those_that_the_options_ask_for(monkeypatch):
    given = []
    monkeypatch.setattr(camera, "Pictures", lambda env, *rest: given.append(rest) or Map(env))
    asked = {"camera": "side, wrist", "picture_size": 32, "renderer": "opengl", "look": "wide", "target": "seen"}
    asked["picture_kind"] = "depth"
    camera.with_camera(hgail_envs.make("push"), TrainOptions("push", observe="camera", teacher=TEACHER, **asked), 1)
    assert given == [(["side", "wrist"], 32, "opengl", "wide", "seen", "depth")]


def test_a_teacher_is_trained_by_the_tasks_own_settings():
    options = TrainOptions(task="push", observe="camera", seeds=3, num_envs=7, rounds=2, settings=("updates=1",))
    teacher = command._teacher_options(options, Path("runs/push-camera-2"))
    assert teacher == TrainOptions(task="push", seeds=3, out=Path("runs/push-camera-2-teacher"))

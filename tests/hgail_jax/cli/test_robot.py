"""The command `robot`, on an arm of capsules and boxes."""

import collections
import types
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from PIL import Image

import hgail_envs
from hgail_envs.vision.rendering import RenderingError
from hgail_jax.cli import main, robot
from hgail_jax.io.policy import load_policy
from hgail_jax.play import portrait
from tests.hgail_envs.robots.arms import FINGERS, MOTORS, arm


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_arm.xml").write_text(arm())
    return tmp_path


def files(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(
    ("content", "options", "line"),
    [
        (arm("", MOTORS), [], "no hand: the joints are one chain"),
        ("<mujoco><worldbody>", [], "my_arm.xml"),
        (arm(), ["--hand", "hand.xml", "--flange", "flange"], "there is no file hand.xml"),
        (arm(), ["--flange", "flange"], "--hand and --flange go together"),
        (arm(), ["--top-speed", "1", "2"], "--top-speed has 2 numbers"),
        (arm(), ["--out", "my_arm.xml"], "it must end in .toml"),
        (arm(fingers=FINGERS.replace("0.04", "0.004")), [], "takes no cube"),
    ],
)
def test_what_is_refused_takes_a_line_and_leaves_no_file(folder, capsys, content, options, line):
    (folder / "my_arm.xml").write_text(content)
    with pytest.raises(SystemExit) as ended:
        main(["robot", "my_arm.xml", *options])
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert ended.value.code == 2 and line in error and error.startswith("hgail robot: ")
    assert files(folder) == ["my_arm.xml"]


@pytest.fixture
def derived(monkeypatch):
    """The description, which takes long to derive and to make a task with, is any text here."""
    written = []

    def make(task, robot, impl):
        written.append(Path(robot).read_text())
        return types.SimpleNamespace(controllers=collections.defaultdict(str))

    monkeypatch.setattr(robot, "derive", lambda given: types.SimpleNamespace(notes=["a note"]))
    monkeypatch.setattr(robot, "_beside", lambda derived, beside: "the description")
    monkeypatch.setattr(robot, "write_description", lambda *given: repr(given))
    monkeypatch.setattr("hgail_envs.make", make)
    monkeypatch.setattr(robot, "portrait", lambda path, env: path.write_bytes(b"half"))
    monkeypatch.setattr(robot, "film", lambda path, env, act, episodes: path.write_text(f"{episodes} episodes"))
    monkeypatch.setattr(robot, "run_controller", lambda env, name, episodes, seed: solved_of(episodes, episodes))
    return written


def solved_of(solved, episodes):
    """Returns what `run_controller` does, with the success of the episodes alone, of which the first ones succeed."""
    return types.SimpleNamespace(outcome=types.SimpleNamespace(success=np.arange(episodes) < solved))


@pytest.mark.parametrize("failing", ["film", "run_controller"])
def test_a_failure_leaves_no_file(folder, derived, monkeypatch, failing):
    monkeypatch.setattr(robot, failing, lambda *given, **named: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(SystemExit, match="2"):
        main(["robot", "my_arm.xml"])
    assert derived == ["('the description', ['a note'])"]
    assert files(folder) == ["my_arm.xml"]


@pytest.mark.parametrize(("solved", "lines"), [(20, []), (18, []), (17, ["nearly all"]), (0, ["never picks"])])
def test_a_script_that_often_fails_is_reported(folder, derived, monkeypatch, capsys, solved, lines):
    monkeypatch.setattr(robot, "run_controller", lambda env, name, episodes, seed: solved_of(solved, episodes))
    if solved:
        main(["robot", "my_arm.xml"])
    else:
        with pytest.raises(SystemExit, match="1"):
            main(["robot", "my_arm.xml"])
    printed = "".join(capsys.readouterr())
    assert f"in {solved} of 20 episodes" in printed
    assert [line for line in ("nearly all", "never picks") if line in printed] == lines
    assert (folder / "my_arm.mp4").read_text() == "2 episodes"
    assert files(folder) == ["my_arm.mp4", "my_arm.png", "my_arm.toml", "my_arm.xml"]


def test_files_that_are_there_stay(folder, capsys):
    (folder / "my_arm.png").write_text("mine")
    with pytest.raises(SystemExit, match="2"):
        main(["robot", "my_arm.xml"])
    assert "my_arm.png exists already" in capsys.readouterr().err
    assert (folder / "my_arm.png").read_text() == "mine"


@pytest.mark.slow  # a film without a GPU, and a training
def test_a_users_arm_is_shown_trained_and_played(folder, capsys, monkeypatch):
    main(["robot", "my_arm.xml", "--top-speed", "3"])
    out = capsys.readouterr().out
    assert "in 20 of 20 episodes" in out
    assert files(folder) == ["my_arm.mp4", "my_arm.png", "my_arm.toml", "my_arm.xml"]
    shown = np.asarray(Image.open("my_arm.png"))
    monkeypatch.setattr(portrait, "_SEE_THROUGH", 1.0)
    portrait.portrait(Path("opaque.png"), hgail_envs.make("pick-and-place", robot="my_arm.toml"))
    assert shown.std() > 10 and (shown != np.asarray(Image.open("opaque.png"))).any()  # of the hand behind its boxes
    env = gymnasium.make("hgail_envs/FetchPush-v0", robot="my_arm.toml")
    assert env.reset(seed=0)[0]["observation"][0] == pytest.approx(1.344, abs=2e-3)
    small = ["--seeds", "1", "--num-envs", "2", "--rounds", "1", "--evaluation-episodes", "2"]
    main(["train", "--task", "push", "--robot", "my_arm.toml", "--out", "run", *small])
    policy = load_policy(folder / "run" / "policies" / "seed-0.npz")
    assert policy.task_options["robot"] == "my_arm.toml"
    main(["evaluate", "--policy", "run", "--episodes", "2"])
    main(["play", "--policy", "run", "--episodes", "1", "--out", "run.webp"])
    main(["export", "--policy", "run", "--out", "run.onnx"])
    assert (folder / "run.webp").stat().st_size > 1000 and (folder / "run.onnx").exists()
    (folder / "my_arm.toml").unlink()
    with pytest.raises(SystemExit, match="2"):
        main(["evaluate", "--policy", "run", "--episodes", "2"])


@pytest.mark.slow
def test_without_a_renderer_the_description_is_written_alone(folder, monkeypatch, capsys):
    def refuse(*given):
        raise RenderingError("MuJoCo cannot render here")

    monkeypatch.setattr(robot, "portrait", refuse)
    main(["robot", "my_arm.xml"])
    assert files(folder) == ["my_arm.toml", "my_arm.xml"]
    assert "no picture and no film: MuJoCo cannot render here" in capsys.readouterr().out

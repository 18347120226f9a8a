"""Runs whose policy sees pictures and has no teacher: a whole folder, and what is refused."""

import csv
import functools
import json

import jax
import numpy as np
import pytest

import hgail_envs
from hgail_envs.scenes import assets_directory
from hgail_jax.cli import evaluate, export, train
from hgail_jax.io.policy import load_any_policy
from hgail_jax.train import train_step
from hgail_jax.trainer import camera, loop
from tests.hgail_jax.vision.scenes import Map
from tests.support import refused

TEACHER = assets_directory() / "policies" / "push.npz"
WITHOUT_TEACHER = ["--observe", "camera", "--learner", "td3"]


def untrained(env, config, states, phases, mesh):
    """Returns a step that trains nothing, with metrics of 0.5."""

    def step(states, phases):
        one = jax.tree.map(lambda leaf: leaf[0], states)
        _, metrics = jax.eval_shape(functools.partial(train_step, env, config), one, phases)
        return states, jax.tree.map(lambda leaf: np.full(states.rng.shape, 0.5), metrics).replace(
            overflow=np.zeros(2), diverged=np.zeros(2), dropped=np.zeros(2)
        )

    return step


@pytest.mark.slow
@pytest.mark.parametrize("trains", [False, True])
def test_a_whole_run_is_trained_evaluated_and_exported(trains, tmp_path, monkeypatch, capsys, rendering):
    """Through OpenGL, in episodes of three steps."""
    monkeypatch.setattr(hgail_envs.find_class("push"), "episode_length", 3)
    monkeypatch.chdir(tmp_path)
    if not trains:
        monkeypatch.setattr(loop, "compile_train_step", untrained)
    sizes = ["--seeds", "2", "--num-envs", "2", "--rounds", "1", "--evaluation-episodes", "2"]
    sizes += ["--camera", "side", "--picture-size", "16", "--renderer", "opengl", "--out", "run"]
    sizes += ["--settings", "rollouts=1", "updates=2", "batch=8", "buffer_episodes=4", "channels=[4,4,4,4]"]
    sizes += ["policy_hidden=[8]", "discriminator_hidden=[8]", "discriminator_minibatches=2", "discriminator_batch=8"]
    train.main(["--task", "push", *WITHOUT_TEACHER, *sizes])
    folder = tmp_path / "run"
    made = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    capsys.readouterr()
    files = ["policies/seed-0.npz", "policies/seed-1.npz"]
    assert [name for name in made if name != ".lock"] == [
        *("config.json", "curves.png", "metrics.csv", *files, "summary.json")
    ]
    said = json.loads((folder / "config.json").read_text())
    assert (said["method"], said["physics"]["pictures"]["teacher"]) == ("hgail", None)
    with open(folder / "metrics.csv") as file:
        rows = list(csv.DictReader(file))
    errors = [row["object_error"] for row in rows]
    assert len(errors) == 4 and all(0.0 < float(error) < 1.0 for error in errors[2:])
    seeds = [load_any_policy(f"run/{name}") for name in files]
    assert seeds[0].cameras == ("side",) and np.any(seeds[0].eyes.action[0] != seeds[1].eyes.action[0])
    evaluate.main(["--policy", "run", "--episodes", "1", "--json"])
    rows = json.loads(capsys.readouterr().out)["policies"]
    assert len(rows) == 2 and all(np.isfinite(row["distance_l2"]) for row in rows)
    export.main(["--policy", f"run/{files[0]}", "--out", "policy.mlirbc", "--episodes", "0"])
    assert (tmp_path / "policy.mlirbc").read_bytes()[:4] == b"ML\xefR"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--learner", "ppo"], "learner of pictures without a teacher is 'ppo'; choose from td3"),
        (["--method", "gasil"], "method of pictures without a teacher is 'gasil'; choose from hgail, her"),
        (["--target", "seen"], "--target seen needs a teacher: hindsight cannot change a target that is in"),
        (["--teacher", str(TEACHER)], "--teacher changes nothing for the learner asymmetric-td3"),
        (["--randomize", "mild"], "--randomize changes nothing for the learner asymmetric-td3"),
        (["--checkpoint-every", "2"], "--checkpoint-every changes nothing for the learner asymmetric-td3"),
        (["--resume", "auto"], "--resume: a run of the learner asymmetric-td3 keeps no checkpoint"),
        (["--settings", "achieved_first=0.5"], "achieved_first is 0.5; with pictures it must be 0"),
        (["--settings", "channels=[4,4]"], "channels is (4, 4); it must be 4 numbers of features"),
        (["--settings", "policy_hidden=[]"], "policy_hidden is empty; a network of pictures needs a hidden layer"),
        (["--settings", "object_weight=-1"], "object_weight is -1"),
        (["--num-envs", "513"], "num_envs, within buffer_episodes (--settings), is 513"),
    ],
)
def test_wrong_options_are_printed_in_one_line(words, message, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(camera, "Pictures", lambda env, *how: Map(env, target=how[4]))
    monkeypatch.chdir(tmp_path)
    refused(train.main, ["--task", "push", *WITHOUT_TEACHER, *words], message, capsys)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [[], ["--learner", "ppo"]])
def test_the_help_is_printed_whatever_else_is_named(words, capsys):
    with pytest.raises(SystemExit) as ended:
        train.main(["--task", "push", *WITHOUT_TEACHER, *words, "--help"])
    assert ended.value.code == 0 and "--observe" in capsys.readouterr().out

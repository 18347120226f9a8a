"""Cameras of the experiment are displaced by what its curves say."""

import json
import types

import numpy as np
import pytest

from experiments import camera_moved
from experiments.camera_moved import Moved, draw, main
from hgail_envs.robots.fetch import Fetch
from hgail_envs.scenes import assets_directory
from hgail_envs.vision.look import FIELDS, LOOKS, draws_of, varied
from hgail_envs.vision.rendering import RenderingError
from hgail_jax.vision.policy import CameraPolicy
from tests.support import refused

MODEL = Fetch("push").load(visual=True)


class Draws:
    """Pictures that are the draws themselves."""

    model = MODEL

    def __call__(self, qpos, draws):
        return draws


@pytest.mark.parametrize(("kind", "amount"), [("shift", 0.07), ("turn", 0.05), ("zoom", 0.08)])
def test_each_camera_is_displaced_by_the_same_amount_in_any_direction(kind, amount):
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, (50, draws_of(MODEL)))
    moved = Moved(Draws(), kind, amount)(None, draws)
    look = varied(MODEL, LOOKS["cameras"], np.asarray(moved, float), np)
    cosine = (np.trace(look["turn"], axis1=-2, axis2=-1) - 1.0) / 2.0
    found = {
        "shift": np.linalg.norm(look["shift"], axis=-1),
        "turn": np.arccos(np.clip(cosine, -1.0, 1.0)),
        "zoom": np.abs(look["cam_fovy"] / MODEL.cam_fovy - 1.0),
    }
    for name, values in found.items():
        np.testing.assert_allclose(values, amount if name == kind else 0.0, rtol=0.02, atol=1e-5, err_msg=name)
    signs = np.sign(look["shift"] if kind == "shift" else look["cam_fovy"] - MODEL.cam_fovy)
    assert kind == "turn" or np.abs(signs.mean(axis=0)).max() < 0.5
    for name in set(FIELDS) - {"cam_fovy"}:
        np.testing.assert_allclose(look[name], np.broadcast_to(getattr(MODEL, name), look[name].shape), atol=1e-6)


def test_the_figure_is_written(tmp_path):
    rows = [
        {"kind": kind, "amount": amount, "success": [1.0 - amount / 20.0, 0.9], "episodes": 50}
        for kind in ("shift", "turn", "zoom")
        for amount in (0.0, 2.0, 8.0)
    ]
    draw(tmp_path / "figure.png", "push", rows)
    assert (tmp_path / "figure.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--shift", "-1"], "shift is -1"),
        (["--episodes", "0"], "episodes is 0; it must be at least 1"),
        ([], "sees positions; a policy with cameras is needed"),
    ],
)
def test_wrong_options_are_printed_in_one_line(words, message, tmp_path, capsys):
    policy = assets_directory() / "policies" / "push.npz"
    refused(main, ["--policy", str(policy), "--out", str(tmp_path / "out"), *words], message, capsys)
    assert not (tmp_path / "out").exists()


@pytest.fixture
def measured(monkeypatch, tmp_path):
    """Has a policy's success be what its cameras are moved by, and runs be in a folder of their own."""
    policy = object.__new__(CameraPolicy)
    vars(policy).update(task="push", cameras=("front",), size=16, goal_size=4, look="varied")
    replaced = {
        "find_task": lambda *_: "push",
        "find_policies": lambda *_: [(tmp_path / "policy.npz", policy)],
        "make_task": lambda *_: types.SimpleNamespace(task=None),
        "Pictures": lambda *_, **__: types.SimpleNamespace(renderer="drawn"),
        "Moved": lambda _, kind, amount: amount,
        "CameraEnv": lambda _, moved: moved,
        "Evaluation": lambda moved, *_: _Evaluated(moved),
        "draw": lambda *_: None,
    }
    for name, by in replaced.items():
        monkeypatch.setattr(camera_moved, name, by)
    monkeypatch.chdir(tmp_path)


class _Evaluated:
    episodes = 2

    def __init__(self, moved):
        self.moved = moved

    def __call__(self, policy):
        return types.SimpleNamespace(success=self.moved)


def test_amounts_are_given_in_the_units_of_the_axes_and_no_folder_is_written_twice(measured, tmp_path, capsys):
    words = ["--policy", "policy.npz", "--shift", "0", "50", "--turn", "90", "--zoom", "25"]
    for number in (1, 2):
        main(words)
        written = json.loads((tmp_path / "runs" / f"camera-moved-{number}" / "camera-moved.json").read_text())
        moved = [row["success"][0] for row in written["rows"]]
        np.testing.assert_allclose(moved, [0.0, 0.5, np.pi / 2, 0.25])
    with pytest.raises(SystemExit):
        main([*words, "--out", "runs/camera-moved-1"])
    assert "runs/camera-moved-1 exists already" in capsys.readouterr().err


def test_where_nothing_can_be_rendered_no_folder_is_made(measured, tmp_path, monkeypatch, capsys):
    def refuse(*_, **__):
        raise RenderingError("MuJoCo cannot render here")

    monkeypatch.setattr(camera_moved, "Pictures", refuse)
    refused(main, ["--policy", "policy.npz"], "MuJoCo cannot render here", capsys)
    assert not list(tmp_path.iterdir())

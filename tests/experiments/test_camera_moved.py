"""Cameras of the experiment are displaced by what its curves say."""

import numpy as np
import pytest

from experiments.camera_moved import Moved, draw, main
from hgail_envs.robots.fetch import Fetch
from hgail_envs.scenes import assets_directory
from hgail_envs.vision.look import FIELDS, LOOKS, draws_of, varied

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
def test_wrong_options_are_told_in_one_line(words, message, tmp_path, capsys):
    policy = assets_directory() / "policies" / "push.npz"
    with pytest.raises(SystemExit):
        main(["--policy", str(policy), "--out", str(tmp_path / "out"), *words])
    told = capsys.readouterr().err
    assert message in told and told.count("\n") == 1 and not (tmp_path / "out").exists()

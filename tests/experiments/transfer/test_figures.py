import imageio.v3 as imageio
import numpy as np
import pytest
from matplotlib import colors

from experiments.transfer.figures import draw_strip, draw_sweep
from experiments.transfer.robots import make_robot

ROW = {"robot": "A, b", "task": "reach", "policy": "plain", "quantity": "noise", "value": 0.0, "success_rate": 0.5}
ROW |= {"success_low": 0.4, "success_high": 0.6}
AXES = {"noise": "noise (m)", "speed": "speed (m/s)"}
POLICIES = ["plain", "other arms", "robust"]


@pytest.mark.parametrize("second", [{"policy": "robust"}, {"quantity": "speed, fast"}])
def test_curves_have_an_ink_for_each_line(tmp_path, second):
    """A second policy's line, and a line in another panel, each change the picture."""
    pictures = []
    for drawn in ([ROW], [ROW, ROW | {"success_rate": 0.2, "success_low": 0.1} | second]):
        draw_sweep(tmp_path / "curves.png", drawn, AXES, POLICIES)
        pictures.append(imageio.imread(tmp_path / "curves.png"))
    assert pictures[0].shape != pictures[1].shape or (pictures[0] != pictures[1]).any()
    assert list(tmp_path.iterdir()) == [tmp_path / "curves.png"]


def inks(path):
    """Returns which of matplotlib's first three colours a picture has, by name."""
    pixels = {tuple(pixel[:3]) for pixel in imageio.imread(path).reshape(-1, 4)}
    names = ("C0", "C1", "C2")
    return [name for name in names if tuple(np.round(255 * np.array(colors.to_rgb(name))).astype(int)) in pixels]


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


def test_a_strip_shows_the_place_that_the_cube_is_brought_to(tmp_path):
    """In Gymnasium's scene too, whose marker is not a child of the world."""
    robot = make_robot("gymnasium", "pick-and-place")
    draw_strip(tmp_path / "strip.png", [(robot, lambda observation: np.zeros(4), [0, 1])], seed=0)
    red, green, blue = np.moveaxis(imageio.imread(tmp_path / "strip.png").astype(int), -1, 0)
    assert red.shape == (240, 2 * 240)
    ball = (red > 100) & (green < 40) & (blue < 40)
    assert ball[:, :240].sum() > 20
    assert ball[:, 240:].sum() > 20

import imageio.v3 as imageio
import pytest

from experiments.transfer.figures import draw_sweep

ROW = {"robot": "A, b", "task": "reach", "quantity": "noise", "value": 0.0, "success_rate": 0.5}
ROW |= {"success_low": 0.4, "success_high": 0.6}


@pytest.mark.parametrize(
    "second",
    [
        {"robot": "C, d", "success_rate": 0.2, "success_low": 0.1},
        {"quantity": "speed, fast"},
    ],
)
def test_curves_have_an_ink_for_each_line(tmp_path, second):
    """A second robot's line, and a line in another panel, each change the picture."""
    pictures = []
    for drawn in ([ROW], [ROW, ROW | second]):
        draw_sweep(tmp_path / "curves.png", drawn, {"noise": "noise (m)", "speed": "speed (m/s)"})
        pictures.append(imageio.imread(tmp_path / "curves.png"))
    assert (pictures[0] != pictures[1]).any()
    assert list(tmp_path.iterdir()) == [tmp_path / "curves.png"]

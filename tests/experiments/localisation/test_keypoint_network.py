import numpy as np
import pytest

from experiments.localisation.keypoint_network import (
    GRID,
    STRIDE,
    labels,
    load_weights,
    predictor,
    save_weights,
    to_pixel,
)
from experiments.paths import WEIGHTS


def test_labels_have_the_pixel_as_their_mean():
    rng = np.random.default_rng(0)
    pixels = rng.uniform(STRIDE / 2, GRID * STRIDE - STRIDE / 2 - 0.1, (50, 2))
    seen = np.arange(50) % 5 > 0
    targets = labels(pixels, seen)
    np.testing.assert_allclose(targets.sum(axis=1), 1.0, rtol=1e-5)
    np.testing.assert_array_equal(targets[:, -1] == 1.0, ~seen)
    found = np.array([to_pixel(target[:-1]) for target in targets[seen]])
    np.testing.assert_allclose(found, pixels[seen], atol=1e-3)


def test_far_cells_do_not_move_the_pixel():
    grid = np.zeros((GRID, GRID))
    grid[5, 7], grid[20, 20] = 0.6, 0.4
    np.testing.assert_allclose(to_pixel(grid.ravel()), [7.5 * STRIDE, 5.5 * STRIDE])


def test_weights_are_small_and_survive_a_file(tmp_path):
    assert WEIGHTS.stat().st_size < 500_000
    weights = load_weights(WEIGHTS)
    save_weights(tmp_path / "weights.npz", weights)
    assert (tmp_path / "weights.npz").stat().st_size == WEIGHTS.stat().st_size


@pytest.mark.parametrize("change", ["missing", "shape", "nan", "type", "rubbish"])
def test_bad_weights_are_refused(change, tmp_path):
    path = tmp_path / "weights.npz"
    with np.load(WEIGHTS) as file:
        arrays = dict(file)
    name = "params/Conv_0/bias"
    if change == "missing":
        del arrays[name]
    elif change == "shape":
        arrays[name] = arrays[name][:-1]
    elif change == "nan":
        arrays[name][0] = np.nan
    elif change == "type":
        arrays[name] = arrays[name].astype(np.float64)
    np.savez(path, **arrays)
    if change == "rubbish":
        path.write_bytes(b"rubbish")
    with pytest.raises(ValueError, match="does not hold the detector's weights"):
        load_weights(path)


def test_a_picture_of_another_size_is_refused():
    predict = predictor(load_weights(WEIGHTS))
    with pytest.raises(ValueError, match="128 by 128 pixels"):
        predict(np.zeros((64, 64, 3), np.uint8), False)

import numpy as np
import pytest

from experiments.localisation import keypoint_training


def test_pictures_move_with_their_labels():
    """A white pixel in a black picture is where the batch's labels say, mirrored and moved or not."""
    rng = np.random.default_rng(0)
    rgb = np.zeros((64, 128, 128, 3), np.uint8)
    at = rng.integers(30, 90, (64, 2))
    rgb[np.arange(64), at[:, 1], at[:, 0]] = 255
    pictures = keypoint_training.Pictures(rgb, at + 0.5, np.ones(64, bool), np.zeros(64, bool))
    (images, targets, _), *_ = keypoint_training._batches(pictures, rng)
    grey = images.mean(axis=-1).reshape(64, -1).argmax(axis=-1)
    where = np.stack([grey % 128, grey // 128], axis=-1) + 0.5
    cells = targets[:, :-1].reshape(64, 32, 32)
    centres = 4 * np.arange(32) + 2.0
    means = np.stack([cells.sum(axis=1) @ centres, cells.sum(axis=2) @ centres], axis=-1)
    np.testing.assert_allclose(means, where, atol=1e-3)
    assert not np.allclose(np.sort(where, axis=0), np.sort(at + 0.5, axis=0))


@pytest.mark.slow
def test_training_learns_to_find_the_target(rendering):
    _, rows = keypoint_training.train(pictures=1024, epochs=12, seed=1)
    assert rows[-1]["loss"] < 0.5 * rows[0]["loss"]
    assert rows[-1]["median_pixels"] < 2.0


def test_labels_of_a_studio_are_the_truth(studio):
    """In a plain scene, where nothing else is red, the labelled pixel is red where the target is in view."""
    rng = np.random.default_rng(2)
    seen = []
    for sample in [studio.draw(rng, marker, False) for marker in (False, True) for _ in range(12)]:
        for view in sample.views:
            if view.camera.contains(view.pixel):
                column, row = view.pixel.astype(int)
                red, green, _ = view.picture.rgb[row, column].astype(int)
                assert (red > 2 * green) == view.seen
                seen.append(view.seen)
    assert 0.6 < np.mean(seen) < 1.0  # some are behind the arm


def test_randomised_scenes_differ_and_seeds_repeat(studio):
    first, again, other = (
        studio.draw(np.random.default_rng(seed), False, True, cameras=1).views[0] for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.picture.rgb, again.picture.rgb)
    np.testing.assert_array_equal(first.picture.depth, again.picture.depth)
    assert np.abs(first.picture.rgb.astype(int) - other.picture.rgb).mean() > 10
    assert np.linalg.norm(first.camera.position - other.camera.position) > 1e-3

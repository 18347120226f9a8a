import numpy as np


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

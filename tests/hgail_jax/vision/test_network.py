"""The network of pictures, and how pictures are varied."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from hgail_envs.vision.depth import FAR
from hgail_envs.vision.look import LOOKS
from hgail_jax.vision.augmentation import AUGMENTATIONS, Augmentation, _blurred, augment
from hgail_jax.vision.network import _places, init_eyes, look


def test_the_place_of_a_feature_is_the_mean_of_where_it_is():
    features = np.random.default_rng(0).normal(size=(2, 5, 7, 3)).astype(np.float32)
    weights = np.exp(features) / np.exp(features).sum(axis=(1, 2), keepdims=True)
    rows, columns = np.linspace(-1, 1, 5)[:, None, None], np.linspace(-1, 1, 7)[None, :, None]
    expected = np.concatenate([(weights * rows).sum((1, 2)), (weights * columns).sum((1, 2))], axis=-1)
    np.testing.assert_allclose(_places(jnp.asarray(features)), expected, atol=1e-5)


@pytest.mark.parametrize("colours", [3, 1])
def test_each_row_depends_on_its_own_pictures_numbers_and_cameras_alone(colours):
    eyes = init_eyes(jax.random.key(0), 2, 3, (4, 4, 4, 4), (8,), (4, 3), colours)
    assert eyes.convolutions[0][0].shape == (5, 5, 2 * colours, 4)
    rng = np.random.default_rng(0)
    pictures, numbers = rng.uniform(size=(3, 2, 16, 16, colours)), rng.normal(size=(3, 3))

    def outputs(pictures, numbers):
        return np.concatenate(jax.jit(look)(eyes, np.float32(pictures), np.float32(numbers)), axis=-1)

    before = outputs(pictures, numbers)
    assert before.shape == (3, 7) and (np.abs(before[:, :4]) <= 1.0).all()
    for changed in (np.s_[1, 0], np.s_[1, 1]):
        other = pictures.copy()
        other[changed] = 1.0 - other[changed]
        after = outputs(other, numbers)
        assert np.abs(after - before)[1].max() > 1e-5
        np.testing.assert_allclose(after[[0, 2]], before[[0, 2]], atol=1e-6)
    assert np.abs(outputs(pictures, numbers + 1.0) - before).min(axis=0).max() > 1e-5


@pytest.mark.parametrize("kind", AUGMENTATIONS)
def test_pictures_of_the_plain_look_are_left_alone(kind):
    pictures = jnp.ones((1, 1, 4, 4, 3))
    assert augment(AUGMENTATIONS[kind]["plain"], jax.random.key(0), pictures) is pictures


@pytest.mark.parametrize("size", [1, 3])
def test_a_shift_continues_the_edge_and_moves_each_picture_along_either_axis_on_its_own(size):
    pictures = jnp.arange(8 * 2 * 8 * 8 * 3.0).reshape(8, 2, 8, 8, 3) / 3072.0
    shifted = np.asarray(augment(Augmentation(shift=size / 8), jax.random.key(3), pictures))
    found = set()
    for sample in range(8):
        for camera in range(2):
            padded = np.pad(np.asarray(pictures[sample, camera]), ((size, size), (size, size), (0, 0)), mode="edge")
            places = [
                (row, column)
                for row in range(2 * size + 1)
                for column in range(2 * size + 1)
                if np.array_equal(padded[row : row + 8, column : column + 8], shifted[sample, camera])
            ]
            assert len(places) == 1
            found.update(places)
    assert len(found) > 2 * size + 1  # as many as there are if one axis decides the other


def test_gains_offsets_and_noise_are_within_their_sizes():
    sizes = Augmentation(gain=0.4, offset=0.2, noise=0.03)
    varied = np.asarray(augment(sizes, jax.random.key(0), jnp.full((64, 2, 16, 16, 3), 0.5)))
    means = varied.mean(axis=(2, 3))
    assert means.min() >= 0.5 * 0.6 - 0.22 and means.max() <= 0.5 * 1.4 + 0.22
    assert means.max() - means.min() > 0.5  # of at most .8
    inside = (means > 0.2) & (means < 0.8)
    np.testing.assert_allclose(varied.std(axis=(2, 3))[inside], 0.03, rtol=0.3)


def test_a_blur_is_scipys_gaussian_filter():
    pictures = np.random.default_rng(0).uniform(size=(2, 3, 12, 9, 3)).astype(np.float32)
    sigma = np.array([[0.0, 0.2, 0.5], [0.8, 1.0, 1.5]], np.float32)
    blurred = np.asarray(jax.jit(_blurred, static_argnums=2)(pictures, sigma, 4))
    for sample, camera in np.ndindex(2, 3):
        expected = gaussian_filter(
            pictures[sample, camera], sigma[sample, camera], mode="nearest", radius=4, axes=(0, 1)
        )
        np.testing.assert_allclose(blurred[sample, camera], expected, atol=1e-6)


def test_the_look_blurred_alone_has_blur_beside_what_varied_has():
    for kind, blurred in (("colour", ["blurred"]), ("depth", [])):
        looks = AUGMENTATIONS[kind]
        assert [look for look in looks if looks[look].blur] == blurred
        assert dataclasses.replace(looks["blurred"], blur=0.0) == looks["varied"]
    assert LOOKS["blurred"] == LOOKS["varied"]


def test_each_picture_is_blurred_on_its_own_up_to_the_size():
    point = jnp.zeros((64, 2, 15, 15, 3)).at[:, :, 7, 7].set(1.0)
    blur = jax.jit(functools.partial(augment, Augmentation(blur=1.0)))
    blurred = np.asarray(blur(jax.random.key(0), point))
    np.testing.assert_allclose(blurred.sum(axis=(2, 3)), 1.0, atol=1e-5)
    places = np.square(np.arange(15) - 7)
    rows, columns = (np.sqrt(blurred.sum(axis=axis) @ np.ones(3) / 3.0 @ places) for axis in (3, 2))
    np.testing.assert_allclose(rows, columns, atol=1e-4)
    assert 0.9 < rows.max() < 1.0 and rows.min() < 0.1
    assert np.abs(rows[:, 0] - rows[:, 1]).mean() > 0.1  # of a uniform distribution .33
    keys = jax.random.split(jax.random.key(1), 2)
    seeds = jax.vmap(blur)(keys, jnp.stack([point] * 2))
    for seed, key in zip(seeds, keys, strict=True):
        np.testing.assert_allclose(seed, blur(key, point), atol=1e-6)


def test_depth_is_varied_by_a_depth_cameras_noise_and_aim_alone():
    sizes = AUGMENTATIONS["depth"]["varied"]
    assert sizes.shift == AUGMENTATIONS["colour"]["varied"].shift
    pictures = jnp.broadcast_to(jnp.linspace(0.3, 0.9, 64)[:, None, None, None, None], (64, 2, 16, 16, 1))
    varied = np.asarray(augment(sizes, jax.random.key(0), pictures))
    assert varied.shape == pictures.shape
    difference = (varied - pictures) * FAR  # metres
    np.testing.assert_allclose(difference.std(axis=(2, 3, 4)), 0.005, rtol=0.25)
    np.testing.assert_allclose(difference.mean(axis=(2, 3, 4)), 0.0, atol=0.002)

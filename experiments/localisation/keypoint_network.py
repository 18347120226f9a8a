"""A small convolutional keypoint detector: a picture in, the pixel at the middle of the target out.

It replaces the paper's detector, a VGG-16 of 138 million parameters: it has 28 thousand, and learns from rendered
pictures alone. For each kind of target it gives a distribution over the cells of a coarse grid and "nowhere"; the mean
over the best cell and its neighbours (a local soft argmax) is the pixel. The weights are an npz of float32 arrays,
named by their path in the parameters, which NumPy alone can read.
"""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from experiments.localisation.localiser import PIXELS, Detection, Detector
from hgail_envs.vision.camera import Camera
from hgail_envs.vision.rgbd import Picture
from hgail_jax.io.files import replace_file
from hgail_jax.io.npz import load_npz

STRIDE = 4
"""Width and height of a cell of the grid, pixels."""
GRID = PIXELS // STRIDE
"""Cells in each row and column of the grid."""
_KINDS = 2  # cube, marker
_FINE_CHANNELS, _CHANNELS = 16, 24  # at half the resolution, and at a quarter
_DILATIONS = (1, 2, 4, 8)
_LEAST_SEEN = 0.5  # probability of a target in the picture, below which it counts as not seen


class KeypointNetwork(nn.Module):
    """Maps colours in [0, 1], `[batch, PIXELS, PIXELS, 3]`, to the logits of each kind, `[batch, 2, GRID² + 1]`.

    The kinds are the cube and the ball; the logits are those of the cells, row by row, and of "nowhere".
    """

    @nn.compact
    def __call__(self, images: jax.Array) -> jax.Array:
        """Applies the layers."""
        hidden = nn.relu(nn.Conv(_FINE_CHANNELS, (5, 5), strides=2)(images - 0.5))
        hidden += nn.relu(nn.Conv(_FINE_CHANNELS, (3, 3))(nn.LayerNorm()(hidden)))
        hidden = nn.relu(nn.Conv(_CHANNELS, (3, 3), strides=2)(hidden))
        for dilation in _DILATIONS:
            hidden += nn.relu(nn.Conv(_CHANNELS, (3, 3), kernel_dilation=dilation)(nn.LayerNorm()(hidden)))
        cells = nn.Conv(_KINDS, (1, 1))(hidden)
        cells = jnp.moveaxis(cells, -1, 1).reshape(images.shape[0], _KINDS, -1)
        pooled = jnp.concatenate([hidden.mean(axis=(1, 2)), hidden.max(axis=(1, 2))], axis=-1)
        return jnp.concatenate([cells, nn.Dense(_KINDS)(pooled)[..., None]], axis=-1)


def labels(pixels: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Returns the distributions to learn, `[batch, GRID² + 1]`.

    The probability is split over the four cells around a pixel (bilinear weights), whose mean is the pixel.

    Args:
      pixels: `[batch, 2]`, (u, v).
      seen: `[batch]`, true if the target is in view; else "nowhere" has all the probability.

    """
    result = np.zeros((len(pixels), GRID**2 + 1), np.float32)
    result[~seen, -1] = 1.0
    where = np.clip(pixels / STRIDE - 0.5, 0, GRID - 1.001)  # just short of the last cell, which has no neighbour
    corner = where.astype(int)
    right, down = (where - corner).T
    rows = np.flatnonzero(seen)
    for row, row_weight in ((0, 1 - down), (1, down)):
        for column, column_weight in ((0, 1 - right), (1, right)):
            cells = (corner[:, 1] + row) * GRID + corner[:, 0] + column
            result[rows, cells[rows]] += (row_weight * column_weight)[rows]
    return result


def to_pixel(probabilities: np.ndarray) -> np.ndarray:
    """Returns the mean pixel (u, v), `[2]`, over the best cell and its neighbours.

    Args:
      probabilities: `[GRID²]`, of the cells, row by row.

    """
    grid = probabilities.reshape(GRID, GRID)
    row, column = np.unravel_index(grid.argmax(), grid.shape)
    cells = np.arange(GRID)
    near = np.outer(np.abs(cells - row) <= 1, np.abs(cells - column) <= 1) * grid
    return STRIDE * (np.array([near.sum(0) @ cells, near.sum(1) @ cells]) / near.sum() + 0.5)


def predictor(params: Any) -> Callable[[np.ndarray, bool], Detection | None]:
    """Returns a function that finds the target in a picture, `[PIXELS, PIXELS, 3]` uint8: the ball where `marker`."""
    apply = jax.jit(functools.partial(KeypointNetwork().apply, params))

    def predict(rgb: np.ndarray, marker: bool) -> Detection | None:
        if rgb.shape != (PIXELS, PIXELS, 3):
            raise ValueError(f"the network reads pictures of {PIXELS} by {PIXELS} pixels, not {rgb.shape[:2]}")
        probabilities = np.asarray(jax.nn.softmax(apply(rgb[None] / np.float32(255))[0, int(marker)]))
        seen = 1.0 - float(probabilities[-1])
        return Detection(to_pixel(probabilities[:-1]), seen) if seen >= _LEAST_SEEN else None

    return predict


@functools.cache
def load_detector(path: Path | str) -> Detector:
    """Returns the detector with the weights of a file; raises the errors of `load_weights`."""
    predict = predictor(load_weights(path))

    def detect(picture: Picture, camera: Camera, marker: bool) -> Detection | None:
        del camera  # the network reads colours only
        return predict(picture.rgb, marker)

    return detect


def save_weights(path: Path | str, params: Any) -> None:
    """Writes a network's parameters."""
    arrays = {name: np.asarray(value) for name, value in traverse_util.flatten_dict(params, sep="/").items()}
    with replace_file(path, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def load_weights(path: Path | str) -> Any:
    """Reads a network's parameters; the file need not be trusted.

    Raises:
      FileNotFoundError: there is no such file.
      ValueError: the file does not hold this network.

    """
    return load_npz(path, "the detector's weights", _from_file)


def _from_file(file: Mapping[str, np.ndarray]) -> Any:
    expected = jax.eval_shape(KeypointNetwork().init, jax.random.key(0), jnp.zeros((1, PIXELS, PIXELS, 3)))
    shapes = {name: leaf.shape for name, leaf in traverse_util.flatten_dict(expected, sep="/").items()}
    if set(file) != set(shapes):
        raise ValueError("its arrays are not those of this network")
    arrays = {name: file[name] for name in shapes}
    for name, array in arrays.items():
        if array.shape != shapes[name]:
            raise ValueError(f"its array {name} has the shape {array.shape}, not {shapes[name]}")
        if array.dtype != np.float32 or not np.isfinite(array).all():
            raise ValueError(f"its array {name} is not all finite float32 numbers")
    return traverse_util.unflatten_dict(arrays, sep="/")

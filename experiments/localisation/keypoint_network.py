"""A small convolutional detector of the target: pixels in, the pixel of its middle out.

It stands for the detector of the paper, a VGG-16 of 138 million parameters, and is not one: it has 28 thousand, and
learns from rendered pictures alone. For each kind of target it gives a distribution over the cells of a coarse grid and
"nowhere"; the mean over the best cell and its neighbours (a soft argmax) is the pixel. The weights are an npz of
float32 arrays that NumPy alone reads, named by their place in the parameters.
"""

import functools
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from envs.vision.camera import Camera
from envs.vision.rgbd import Picture
from experiments.localisation.localiser import PIXELS, Detection, Detector
from hgail_jax.io.files import replace_file

STRIDE = 4
"""Pixels that a cell of the grid is wide."""
GRID = PIXELS // STRIDE
"""Cells in a row of the grid, and in a column."""
_KINDS = 2  # cube, marker
_FINE_CHANNELS, _CHANNELS = 16, 24  # at half the resolution, and at a quarter
_DILATIONS = (1, 2, 4, 8)
_LEAST_SEEN = 0.5  # probability that the target is anywhere, below which it is not seen


class KeypointNetwork(nn.Module):
    """Colours, `[batch, PIXELS, PIXELS, 3]` in 0 to 1, to logits of each kind, `[batch, 2, GRID² + 1]`.

    The logits are of the cells, row by row, and of "nowhere".
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

    A pixel is shared out among the four cells around it so that their mean is the pixel.

    Args:
      pixels: `[batch, 2]`, (u, v).
      seen: `[batch]`, whether the target is in view; else all is on "nowhere".

    """
    result = np.zeros((len(pixels), GRID**2 + 1), np.float32)
    result[~seen, -1] = 1.0
    where = np.clip(pixels / STRIDE - 0.5, 0, GRID - 1.001)
    corner = where.astype(int)
    right, down = (where - corner).T
    rows = np.flatnonzero(seen)
    for row, row_share in ((0, 1 - down), (1, down)):
        for column, column_share in ((0, 1 - right), (1, right)):
            cells = (corner[:, 1] + row) * GRID + corner[:, 0] + column
            result[rows, cells[rows]] += (row_share * column_share)[rows]
    return result


def to_pixel(probabilities: np.ndarray) -> np.ndarray:
    """Returns the mean pixel (u, v), `[2]`, of the best cell and its neighbours, of `[GRID²]` probabilities."""
    grid = probabilities.reshape(GRID, GRID)
    row, column = np.unravel_index(grid.argmax(), grid.shape)
    cells = np.arange(GRID)
    near = np.outer(np.abs(cells - row) <= 1, np.abs(cells - column) <= 1) * grid
    return STRIDE * (np.array([near.sum(0) @ cells, near.sum(1) @ cells]) / near.sum() + 0.5)


def predictor(params: Any) -> Callable[[np.ndarray, bool], Detection | None]:
    """Returns what finds the target in a picture, `[PIXELS, PIXELS, 3]` uint8; the boolean asks for the ball."""
    apply = jax.jit(functools.partial(KeypointNetwork().apply, params))

    def predict(rgb: np.ndarray, marker: bool) -> Detection | None:
        if rgb.shape != (PIXELS, PIXELS, 3):
            raise ValueError(f"the network reads pictures of {PIXELS} by {PIXELS} pixels, not {rgb.shape[:2]}")
        probabilities = np.asarray(jax.nn.softmax(apply(rgb[None] / np.float32(255))[0, int(marker)]))
        seen = 1.0 - float(probabilities[-1])
        return Detection(to_pixel(probabilities[:-1]), seen) if seen >= _LEAST_SEEN else None

    return predict


def load_detector(path: Path | str) -> Detector:
    """Returns the detector whose weights are in a file; see `load_weights` for what is raised."""
    predict = predictor(load_weights(path))

    def detect(picture: Picture, camera: Camera, marker: bool) -> Detection | None:
        del camera  # colours alone
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
      ValueError: it does not hold this network.

    """
    expected = jax.eval_shape(KeypointNetwork().init, jax.random.key(0), jnp.zeros((1, PIXELS, PIXELS, 3)))
    shapes = {name: leaf.shape for name, leaf in traverse_util.flatten_dict(expected, sep="/").items()}
    try:
        with zipfile.ZipFile(path) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise ValueError("it is compressed")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        if {name: array.shape for name, array in arrays.items()} != shapes:
            raise ValueError("its arrays are not those of this network")
        if not all(array.dtype == np.float32 and np.isfinite(array).all() for array in arrays.values()):
            raise ValueError("not all of its arrays are finite float32 numbers")
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(f"{path} holds no weights of the detector: {error}") from error
    return traverse_util.unflatten_dict(arrays, sep="/")

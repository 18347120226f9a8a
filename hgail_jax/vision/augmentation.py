"""Varies pictures as images, whatever rendered them: a camera's exposure, white balance, blur, noise and aim.

What varies in the scene itself, `hgail_envs.vision.look` draws once an episode; this is drawn for each sample.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp

from hgail_envs.vision.depth import FAR
from hgail_envs.vision.look import LOOKS


@dataclasses.dataclass(frozen=True)
class Augmentation:
    """Sizes of the variation; all are 0 for none."""

    gain: float = 0.0
    """Bound of each colour channel's factor around 1: exposure and white balance."""
    offset: float = 0.0
    """Bound of each colour channel's offset, in a range of 1: haze and stray light."""
    blur: float = 0.0
    """Largest standard deviation of a Gaussian blur, pixels; the border is continued."""
    noise: float = 0.0
    """Standard deviation of each number's noise, in a range of 1."""
    shift: float = 0.0
    """Largest shift along each axis, as a fraction of the picture's edge; the border is continued."""


# Three quarters of a stop under to half a stop over is what a camera that sets its own exposure leaves; .03 is a small
# sensor's noise indoors. Three of 64 pixels are about two degrees: a camera that was nudged.
_VARIED = Augmentation(gain=0.4, offset=0.2, noise=0.03, shift=3 / 64)
# A pixel of 64 is 1.3 cm at the table. A hand at a metre a second moves by two and a half in an exposure of a thirtieth
# of a second: smeared evenly, a standard deviation of .7. Making a picture small, by the mean of what a pixel covers,
# adds .3, together .8; the rest is for a lens that is out of focus.
_BLURRED = dataclasses.replace(_VARIED, blur=1.0)
# A tenth of a pixel of disparity is 5 mm at a metre, for a stereo camera whose lenses are 5 cm apart and whose focal
# length is 430 pixels; neither exposure nor white balance nor blur is in a distance.
_VARIED_DEPTH = Augmentation(noise=0.005 / FAR, shift=_VARIED.shift)
AUGMENTATIONS = {
    kind: dict.fromkeys(LOOKS, Augmentation())
    | dict.fromkeys(("varied", "shadowless", "things", "wide", "late", "image"), sizes)
    | {"blurred": blurred}
    for kind, sizes, blurred in (("colour", _VARIED, _BLURRED), ("depth", _VARIED_DEPTH, _VARIED_DEPTH))
}
"""By the kind of the pictures and the name of the look."""
_SHARP = 1e-3  # pixels; less would divide by 0, and blurs as little


def augment(sizes: Augmentation, rng: jax.Array, pictures: jax.Array) -> jax.Array:
    """Returns varied pictures, `[B, cameras, H, W, colours]` in [0, 1]; each is varied on its own."""
    if sizes == Augmentation():
        return pictures
    gain_rng, offset_rng, noise_rng, shift_rng = jax.random.split(rng, 4)
    batch, cameras, height, width, colours = pictures.shape
    channels = (batch, cameras, 1, 1, colours)
    gain = 1.0 + sizes.gain * jax.random.uniform(gain_rng, channels, minval=-1.0)
    pictures = pictures * gain + sizes.offset * jax.random.uniform(offset_rng, channels, minval=-1.0)
    if sizes.blur:
        blur_rng = jax.random.fold_in(rng, 4)  # a fifth of the `split` would change the other four
        sigma = sizes.blur * jax.random.uniform(blur_rng, (batch, cameras))
        pictures = _blurred(pictures, sigma, math.ceil(3.0 * sizes.blur))
    pictures = jnp.clip(pictures + sizes.noise * jax.random.normal(noise_rng, pictures.shape), 0.0, 1.0)
    most = round(sizes.shift * height)
    shifts = jax.random.randint(shift_rng, (2, batch, cameras, 1), -most, most + 1)
    rows = jnp.clip(jnp.arange(height) + shifts[0], 0, height - 1)
    columns = jnp.clip(jnp.arange(width) + shifts[1], 0, width - 1)
    pictures = jnp.take_along_axis(pictures, rows[..., :, None, None], axis=2)
    return jnp.take_along_axis(pictures, columns[..., None, :, None], axis=3)


def _blurred(pictures: jax.Array, sigma: jax.Array, reach: int) -> jax.Array:
    """Returns pictures, `[B, cameras, H, W, colours]`, after a Gaussian blur of each, `sigma` `[B, cameras]`, pixels.

    The kernel ends `reach` pixels from its middle.
    """
    offsets = jnp.arange(-reach, reach + 1)
    weights = jnp.exp(-0.5 * jnp.square(offsets / jnp.maximum(sigma, _SHARP)[..., None]))
    weights = (weights / weights.sum(axis=-1, keepdims=True))[..., None, None, None]
    for axis in (2, 3):
        around = [(reach, reach) if other == axis else (0, 0) for other in range(pictures.ndim)]
        padded, size = jnp.pad(pictures, around, mode="edge"), pictures.shape[axis]
        moved = (jax.lax.slice_in_dim(padded, place, place + size, axis=axis) for place in range(2 * reach + 1))
        pictures = functools.reduce(jnp.add, (weights[:, :, place] * each for place, each in enumerate(moved)))
    return pictures

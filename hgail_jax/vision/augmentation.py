"""Varies pictures as images, whatever rendered them: a camera's exposure, white balance, noise and aim.

What varies in the scene itself, `hgail_envs.vision.look` draws once an episode; this is drawn for each sample.
"""

import dataclasses

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
    noise: float = 0.0
    """Standard deviation of each number's noise, in a range of 1."""
    shift: float = 0.0
    """Largest shift along each axis, as a fraction of the picture's edge; the border is continued."""


# Three quarters of a stop under to half a stop over is what a camera that sets its own exposure leaves; .03 is a small
# sensor's noise indoors. Three of 64 pixels are about two degrees: a camera that was nudged.
_VARIED = Augmentation(gain=0.4, offset=0.2, noise=0.03, shift=3 / 64)
# A tenth of a pixel of disparity is 5 mm at a metre, for a stereo camera whose lenses are 5 cm apart and whose focal
# length is 430 pixels; neither exposure nor white balance is in a distance.
_VARIED_DEPTH = Augmentation(noise=0.005 / FAR, shift=_VARIED.shift)
AUGMENTATIONS = {
    kind: dict.fromkeys(LOOKS, Augmentation())
    | dict.fromkeys(("varied", "shadowless", "things", "wide", "late", "image"), sizes)
    for kind, sizes in (("colour", _VARIED), ("depth", _VARIED_DEPTH))
}
"""By the kind of the pictures and the name of the look."""


def augment(sizes: Augmentation, rng: jax.Array, pictures: jax.Array) -> jax.Array:
    """Returns varied pictures, `[B, cameras, H, W, colours]` in [0, 1]; each is varied on its own."""
    if sizes == Augmentation():
        return pictures
    gain_rng, offset_rng, noise_rng, shift_rng = jax.random.split(rng, 4)
    batch, cameras, height, width, colours = pictures.shape
    channels = (batch, cameras, 1, 1, colours)
    gain = 1.0 + sizes.gain * jax.random.uniform(gain_rng, channels, minval=-1.0)
    pictures = pictures * gain + sizes.offset * jax.random.uniform(offset_rng, channels, minval=-1.0)
    pictures = jnp.clip(pictures + sizes.noise * jax.random.normal(noise_rng, pictures.shape), 0.0, 1.0)
    most = round(sizes.shift * height)
    shifts = jax.random.randint(shift_rng, (2, batch, cameras, 1), -most, most + 1)
    rows = jnp.clip(jnp.arange(height) + shifts[0], 0, height - 1)
    columns = jnp.clip(jnp.arange(width) + shifts[1], 0, width - 1)
    pictures = jnp.take_along_axis(pictures, rows[..., :, None, None], axis=2)
    return jnp.take_along_axis(pictures, columns[..., None, :, None], axis=3)

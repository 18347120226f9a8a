"""Varies pictures as images, whatever rendered them: a camera's exposure, white balance, noise and aim.

What varies in the scene itself, `hgail_envs.vision.look` draws once an episode; this is drawn for each sample.
"""

import dataclasses

import jax
import jax.numpy as jnp

from hgail_envs.vision.look import LOOKS


@dataclasses.dataclass(frozen=True)
class Augmentation:
    """Sizes of the variation; all are 0 for none."""

    gain: float = 0.0
    """Bound of each colour channel's factor around 1: exposure and white balance."""
    offset: float = 0.0
    """Bound of each colour channel's offset, in a range of 1: haze and stray light."""
    noise: float = 0.0
    """Standard deviation of each number's noise."""
    shift: float = 0.0
    """Largest shift along each axis, as a fraction of the picture's edge; the border is continued."""


# Three quarters of a stop under to half a stop over is what a camera that sets its own exposure leaves; .03 is a small
# sensor's noise indoors. Three of 64 pixels are about two degrees: a camera that was nudged. With these a student saw
# through another renderer where one without saw little: success .68 for .15 on push.
_VARIED = Augmentation(gain=0.4, offset=0.2, noise=0.03, shift=3 / 64)
AUGMENTATIONS = dict.fromkeys(LOOKS, Augmentation()) | dict.fromkeys(
    ("varied", "shadowless", "things", "wide", "late", "image"), _VARIED
)
"""By the name of the look."""


def augment(sizes: Augmentation, rng: jax.Array, pictures: jax.Array) -> jax.Array:
    """Returns varied pictures, `[B, cameras, H, W, 3]` in [0, 1]; each camera of each sample is varied on its own."""
    if sizes == Augmentation():
        return pictures
    gain_rng, offset_rng, noise_rng, shift_rng = jax.random.split(rng, 4)
    batch, cameras, height, width, _ = pictures.shape
    channels = (batch, cameras, 1, 1, 3)
    gain = 1.0 + sizes.gain * jax.random.uniform(gain_rng, channels, minval=-1.0)
    pictures = pictures * gain + sizes.offset * jax.random.uniform(offset_rng, channels, minval=-1.0)
    pictures = jnp.clip(pictures + sizes.noise * jax.random.normal(noise_rng, pictures.shape), 0.0, 1.0)
    most = round(sizes.shift * height)
    shifts = jax.random.randint(shift_rng, (2, batch, cameras, 1), -most, most + 1)
    rows = jnp.clip(jnp.arange(height) + shifts[0], 0, height - 1)
    columns = jnp.clip(jnp.arange(width) + shifts[1], 0, width - 1)
    pictures = jnp.take_along_axis(pictures, rows[..., :, None, None], axis=2)
    return jnp.take_along_axis(pictures, columns[..., None, :, None], axis=3)

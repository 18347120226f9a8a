"""Trains the detector of `keypoint_network` on pictures of randomised scenes."""

import dataclasses
import math
import time
from collections.abc import Callable, Iterator
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.localisation.keypoint_network import KeypointNetwork, labels, predictor
from experiments.localisation.localiser import PIXELS
from experiments.localisation.random_scenes import Studio
from hgail_jax.terminal.status import progress_bar

_BATCH = 64
_LEARNING_RATE, _WEIGHT_DECAY = 3e-3, 1e-4
_WARM_UP = 0.1  # fraction of the steps in which the learning rate rises
_SHIFT = 8  # pixels, the largest shift of a picture in each direction
_COLOUR_NOISE = 0.02  # standard deviation, colours being in [0, 1]
_HELD_OUT = 0.1  # size of the held-out set, relative to the training set


@dataclasses.dataclass(frozen=True)
class Pictures:
    """Labelled pictures."""

    rgb: np.ndarray
    """`[count, PIXELS, PIXELS, 3]`, uint8."""
    pixels: np.ndarray
    """`[count, 2]`, see `random_scenes.View`."""
    seen: np.ndarray
    """`[count]`, boolean."""
    markers: np.ndarray
    """`[count]`, boolean: true if the target is the ball."""


def take_pictures(studio: Studio, count: int, rng: np.random.Generator, title: str) -> Pictures:
    """Takes one picture of each of `count` randomised scenes, alternately with the cube and with the ball."""
    rgb = np.empty((count, PIXELS, PIXELS, 3), np.uint8)
    pixels, seen, markers = np.empty((count, 2)), np.empty(count, bool), np.arange(count) % 2 == 1
    for index in progress_bar(range(count), desc=title, unit="picture"):
        view = studio.draw(rng, bool(markers[index]), randomised=True, cameras=None).views[0]
        rgb[index], pixels[index], seen[index] = view.picture.rgb, view.pixel, view.seen
    return Pictures(rgb, pixels, seen, markers)


def train(pictures: int, epochs: int, seed: int) -> tuple[Any, list[dict]]:
    """Takes pictures and trains a network on them.

    Args:
      pictures: number to learn from.
      epochs: passes over them.
      seed: of the pictures, the initial parameters and the batches.

    Returns:
      The parameters, and a row per epoch: mean loss, the result of `validate` on held-out pictures, and seconds so far.

    Raises:
      RuntimeError: MuJoCo cannot render here.

    """
    started = time.perf_counter()
    rng, validation_rng = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    with Studio() as studio:
        held_out = take_pictures(studio, math.ceil(_HELD_OUT * pictures), validation_rng, "held-out pictures")
        training = take_pictures(studio, pictures, rng, "pictures")
    steps = epochs * (pictures // _BATCH)
    network = KeypointNetwork()
    params = jax.jit(network.init)(jax.random.key(seed), jnp.zeros((1, PIXELS, PIXELS, 3)))
    rate = optax.cosine_onecycle_schedule(steps, _LEARNING_RATE, _WARM_UP)
    optimiser = optax.adamw(rate, weight_decay=_WEIGHT_DECAY)
    update, opt_state = _make_update(network, optimiser), jax.jit(optimiser.init)(params)
    rows = []
    with progress_bar(total=steps, desc="training", unit="batch") as progress:
        for epoch in range(epochs):
            losses = []
            for batch in _batches(training, rng):
                params, opt_state, loss = update(params, opt_state, *batch)
                losses.append(float(loss))
                progress.update()
            rows.append({"epoch": epoch + 1, "loss": np.mean(losses)} | validate(params, held_out))
            rows[-1]["seconds"] = round(time.perf_counter() - started, 1)
            progress.set_postfix({"loss": f"{rows[-1]['loss']:.2f}", "pixels": f"{rows[-1]['median_pixels']:.2f}"})
    return params, rows


def validate(params: Any, pictures: Pictures) -> dict[str, float]:
    """Returns a network's errors on pictures.

    `median_pixels` and `p95_pixels` are distances from the truth of targets in view that are found. `missed_rate` is
    the rate of false negatives, targets in view that are not found; `imagined_rate` that of false positives, hidden
    targets that are found.
    """
    predict = predictor(params)
    errors: list[float] = []
    missed: list[bool] = []
    imagined: list[bool] = []
    for rgb, pixel, seen, marker in zip(pictures.rgb, pictures.pixels, pictures.seen, pictures.markers, strict=True):
        detection = predict(rgb, bool(marker))
        if seen:
            missed.append(detection is None)
        else:
            imagined.append(detection is not None)
        if seen and detection is not None:
            errors.append(float(np.linalg.norm(detection.pixel - pixel)))
    quantiles = np.quantile(errors, [0.5, 0.95]) if errors else [np.nan, np.nan]
    return {
        "median_pixels": float(quantiles[0]),
        "p95_pixels": float(quantiles[1]),
        "missed_rate": float(np.mean(missed)) if missed else np.nan,
        "imagined_rate": float(np.mean(imagined)) if imagined else np.nan,
    }


def _make_update(network: KeypointNetwork, optimiser: optax.GradientTransformation) -> Callable[..., tuple]:
    """Returns the compiled training step, from (parameters, optimiser's state, batch) to new ones and the loss."""

    def loss_of(params: Any, rgb: jax.Array, targets: jax.Array, kinds: jax.Array) -> jax.Array:
        logits = cast(jax.Array, network.apply(params, rgb))[jnp.arange(len(kinds)), kinds]
        return optax.softmax_cross_entropy(logits, targets).mean()

    @jax.jit
    def update(
        params: Any, opt_state: Any, rgb: jax.Array, targets: jax.Array, kinds: jax.Array
    ) -> tuple[Any, Any, jax.Array]:
        loss, gradients = jax.value_and_grad(loss_of)(params, rgb, targets, kinds)
        updates, opt_state = optimiser.update(gradients, opt_state, params)
        return optax.apply_updates(params, updates), opt_state, loss

    return update


def _batches(pictures: Pictures, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yields the shuffled, augmented batches of an epoch.

    Half the pictures are mirrored; all are shifted by a few pixels and have noise on their colours.

    Yields:
      Colours in [0, 1], `[_BATCH, PIXELS, PIXELS, 3]`; labels, `[_BATCH, GRID² + 1]`, see `labels`; and kinds of
      target, `[_BATCH]`, 0 for the cube and 1 for the ball.

    """
    order = rng.permutation(len(pictures.rgb))
    for chosen in order[: len(order) // _BATCH * _BATCH].reshape(-1, _BATCH):
        rgb, pixels = pictures.rgb[chosen], pictures.pixels[chosen]
        mirrored = rng.random(_BATCH) < 0.5
        rgb[mirrored] = rgb[mirrored, :, ::-1]
        pixels[mirrored, 0] = PIXELS - pixels[mirrored, 0]
        shifts = rng.integers(-_SHIFT, _SHIFT + 1, (_BATCH, 2))
        rgb = np.stack([_shifted(one, shift) for one, shift in zip(rgb, shifts, strict=True)])
        noisy = rgb / np.float32(255) + _COLOUR_NOISE * rng.standard_normal(rgb.shape, np.float32)
        pixels = pixels + shifts
        inside = np.all((pixels >= 0) & (pixels < PIXELS), axis=-1)
        targets = labels(pixels, pictures.seen[chosen] & inside)
        yield np.clip(noisy, 0.0, 1.0), targets, pictures.markers[chosen].astype(int)


def _shifted(rgb: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Returns a picture shifted by (right, down) pixels; its edge pixels fill the rest."""
    right, down = shift
    padded = np.pad(rgb, ((_SHIFT, _SHIFT), (_SHIFT, _SHIFT), (0, 0)), mode="edge")
    return padded[_SHIFT - down : _SHIFT - down + PIXELS, _SHIFT - right : _SHIFT - right + PIXELS]

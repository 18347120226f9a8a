"""Measures the error of localised positions, without noise and with each kind of noise."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.localisation.localiser import Detector, Noise, Sighting, locate, sight
from experiments.localisation.random_scenes import Sample, Studio
from hgail_jax.terminal.status import progress_bar

SWEEPS: dict[str, tuple[float, ...]] = {
    "pixel": (0.0, 0.5, 1.0, 2.0, 4.0, 8.0),
    "depth": (0.0, 0.002, 0.005, 0.01, 0.02, 0.04),
    "rotation": (0.0, 0.25, 0.5, 1.0, 2.0, 4.0),
    "translation": (0.0, 0.002, 0.005, 0.01, 0.02, 0.04),
}
"""Standard deviations to measure, for each field of `Noise` and in its unit."""

_EXAMPLES = 4  # samples of each kind of scene that are kept for pictures
_REPEATS = 4  # draws of the noise per scene
_FAR = 50.0  # millimetres, the tasks' threshold of success
_TARGETS = {"cube": False, "marker": True}
_SCENES = {"plain": False, "randomised": True}


@dataclasses.dataclass(frozen=True)
class Found:
    """Target that a detector found."""

    sightings: Sequence[Sighting]
    """At least one, that of the highest score first."""
    position: np.ndarray
    """`[3]`: the target's true centre, metres."""
    marker: bool
    """True if the target is the ball, false if it is the cube."""


def find(sample: Sample, detect: Detector) -> Found | None:
    """Returns a detector's sightings of a sample's target; None if no view has one."""
    sightings = sight(((view.picture, view.camera) for view in sample.views), detect, sample.marker)
    return Found(sightings, sample.position, sample.marker) if sightings else None


def errors(found: list[Found], noise: Noise, rng: np.random.Generator, repeats: int = 1) -> np.ndarray:
    """Returns distances of the estimates from the truth, `[repeats * len(found)]`, millimetres."""

    def error(one: Found) -> float:
        return 1e3 * float(np.linalg.norm(locate(one.sightings, one.marker, noise, rng) - one.position))

    return np.array([error(one) for _ in range(repeats) for one in found])


def measure(
    studio: Studio, detectors: Mapping[str, Detector], count: int, seed: int
) -> tuple[list[dict], list[dict], dict[str, list[Sample]]]:
    """Measures detectors on `count` scenes of each kind.

    Returns:
      - The table without noise: a row per target, kind of scene, number of cameras and detector.
      - The sweeps: a row per target, detector, kind of noise and its size, in plain scenes with two cameras.
      - A few samples, by target and kind of scene.

    """
    table, sweeps, examples = [], [], {}
    for target, marker in _TARGETS.items():
        for scene, randomised in _SCENES.items():
            # These are not the scenes of a training, whose generators are seeded by `seed` and by [seed, 1].
            rng = np.random.default_rng([seed, marker, randomised])
            samples = [
                studio.draw(rng, marker, randomised)
                for _ in progress_bar(range(count), desc=f"{target}, {scene} scenes", unit="scene")
            ]
            examples[f"{target}, {scene}"] = samples[:_EXAMPLES]
            for cameras in (1, 2):
                seen = [dataclasses.replace(sample, views=sample.views[:cameras]) for sample in samples]
                for name, detect in detectors.items():
                    labels = {"target": target, "scenes": scene, "cameras": cameras, "detector": name}
                    found = [find(sample, detect) for sample in seen]
                    table.append(labels | _row(seen, found))
                    if not randomised and cameras == len(samples[0].views):
                        kept = [one for one in found if one is not None]
                        sweeps += [{"target": target, "detector": name} | row for row in _sweep(kept, seed)]
    return table, sweeps, examples


def quantiles(millimetres: np.ndarray) -> dict[str, float]:
    """Returns the median and the 95th percentile of errors, `[count]`; NaN if there are no errors.

    >>> quantiles(np.arange(101.0))
    {'median_mm': 50.0, 'p95_mm': 95.0}
    """
    if not len(millimetres):
        return {"median_mm": np.nan, "p95_mm": np.nan}
    return {"median_mm": float(np.median(millimetres)), "p95_mm": float(np.quantile(millimetres, 0.95))}


def _row(samples: list[Sample], found: list[Found | None]) -> dict[str, float]:
    """Returns the measured columns of a row of the table."""
    hidden = [not any(view.seen for view in sample.views) for sample in samples]
    none = [one is None for one in found]
    millimetres = errors([one for one in found if one is not None], Noise(), np.random.default_rng(0))
    return {
        "count": len(samples),
        "hidden_rate": float(np.mean(hidden)),
        "not_found_rate": float(np.mean(none)),
        **quantiles(millimetres),
        "far_rate": float(np.sum(millimetres > _FAR) / len(samples)),
    }


def _sweep(found: list[Found], seed: int) -> list[dict]:
    """Returns a row for each kind of noise and its size."""
    rows = []
    for kind, values in SWEEPS.items():
        for value in values:
            distances = errors(found, Noise(**{kind: value}), np.random.default_rng(seed), repeats=_REPEATS)
            rows.append({"noise": kind, "value": value, **quantiles(distances)})
    return rows

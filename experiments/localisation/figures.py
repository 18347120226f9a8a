"""Draws a localiser's error over noise, and examples of its pictures with the detections marked."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt

from experiments.figures import style_axes, write_figure
from experiments.localisation.error import SWEEPS, find
from experiments.localisation.localiser import Detector
from experiments.localisation.random_scenes import Sample

_AXES = {  # of each field of `Noise`: label, and factor to the label's unit
    "pixel": ("pixel noise σ (pixels)", 1.0),
    "depth": ("depth noise σ (mm)", 1e3),
    "rotation": ("camera rotation error σ per axis (°)", 1.0),
    "translation": ("camera position error σ per axis (mm)", 1e3),
}
_COLOURS = {"cube": "#1f5f8b", "marker": "#b5482f"}
_LINES = {"median_mm": "-", "p95_mm": ":"}
_SUCCESS = 50.0  # millimetres; the tasks' threshold of success
_MARKS = {"colour": ("+", "#00e5ff"), "network": ("x", "#39ff14")}


def draw_sweeps(path: Path, rows: list[dict], detector: str) -> None:
    """Writes a PNG of the error over each kind of noise, median and 95th percentile, for each target."""
    figure, axes = plt.subplots(1, len(SWEEPS), figsize=(13, 3.4), constrained_layout=True, sharey=True)
    for axis, noise in zip(axes, SWEEPS, strict=True):
        label, unit = _AXES[noise]
        for target, colour in _COLOURS.items():
            line = [row for row in rows if (row["target"], row["detector"], row["noise"]) == (target, detector, noise)]
            values = [unit * row["value"] for row in line]
            for column, style in _LINES.items():
                name = f"{target}, {'median' if column == 'median_mm' else '95th percentile'}"
                axis.plot(values, [row[column] for row in line], style, color=colour, marker="o", ms=3, label=name)
        axis.axhline(_SUCCESS, color="grey", linewidth=0.8, linestyle="--")
        axis.set(xlabel=label, ylim=(0, 100))
        style_axes(axis)
    axes[0].set_ylabel("error of the position (mm)")
    axes[0].legend(fontsize=8, frameon=False)
    figure.suptitle(f"Localisation by the {detector} in plain scenes; dashed: the tasks' 5 cm", fontsize=11)
    write_figure(figure, path, dpi=110)


def draw_examples(path: Path, examples: Mapping[str, list[Sample]], detectors: Mapping[str, Detector]) -> None:
    """Writes a PNG of samples, a row for each kind, with each detector's detections marked.

    It shows the best view of the last detector for each sample, without detections in other views.
    """
    columns = max(len(samples) for samples in examples.values())
    figure, grid = plt.subplots(
        len(examples), columns, figsize=(2.2 * columns, 2.3 * len(examples)), squeeze=False, constrained_layout=True
    )
    for axes, (title, samples) in zip(grid, examples.items(), strict=True):
        axes[0].set_title(title, fontsize=9, loc="left")
        for axis, sample in zip(axes, samples, strict=False):
            found = {name: find(sample, detect) for name, detect in detectors.items()}
            best = {name: one.sightings[0] for name, one in found.items() if one is not None}
            shown = next((sighting.picture for sighting in reversed(best.values())), sample.views[0].picture)
            height, width = shown.depth.shape
            axis.imshow(shown.rgb, extent=(0, width, height, 0))
            for name, sighting in best.items():
                if sighting.picture is shown:
                    mark, colour = _MARKS[name]
                    axis.plot(*sighting.detection.pixel, mark, color=colour, ms=9, mew=1.5)
        for axis in axes:
            axis.set_axis_off()
    handles = [
        plt.Line2D([], [], linestyle="", marker=mark, color=colour, label=name)
        for name, (mark, colour) in _MARKS.items()
        if name in detectors
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=8)
    write_figure(figure, path, dpi=110)

"""Style and files of the experiments' figures."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

from hgail_jax.io.files import replace_file


def style_axes(axes: plt.Axes) -> None:
    """Draws a faint grid, and removes the upper and right borders."""
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def write_figure(figure: plt.Figure, path: Path, dpi: int) -> None:
    """Writes a figure as PNG, and closes it."""
    with replace_file(path, "wb") as file:
        figure.savefig(file, dpi=dpi, format="png")
    plt.close(figure)

"""Draws learning curves: success and distance over environment steps, for all seeds of a run."""

from pathlib import Path

import numpy as np

from hgail_jax.io.files import replace_file

_COLOR = "#1f5f8b"


def draw_curves(path: Path, title: str, env_steps: np.ndarray, success: np.ndarray, distance: np.ndarray) -> None:
    """Writes a PNG: each seed thin, their mean thick, a band of one standard deviation around it.

    Args:
      path: where to.
      title: printed above.
      env_steps: `[rounds]`, steps learnt from so far, per seed.
      success: `[rounds, seeds]`, success rate of the mean action.
      distance: `[rounds, seeds]`, L1 distance at the end of the episode, metres.

    """
    from matplotlib.figure import Figure  # not pyplot, whose backend is the user's; late, for it takes its time

    figure = Figure(figsize=(9, 3.4), layout="constrained")
    axes = figure.subplots(1, 2)
    panels = ((success, "success rate", (-0.02, 1.02)), (distance, "L1 distance at the end (m)", (0.0, None)))
    for axis, (values, label, limits) in zip(axes, panels, strict=True):
        mean, std = values.mean(axis=1), values.std(axis=1)
        axis.plot(env_steps, values, color=_COLOR, alpha=0.3, linewidth=0.7)
        axis.fill_between(env_steps, mean - std, mean + std, color=_COLOR, alpha=0.15, linewidth=0)
        axis.plot(env_steps, mean, color=_COLOR, linewidth=2, marker="o", markersize=4)
        axis.set(xlabel="environment steps per seed", ylabel=label, ylim=limits)
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title, fontsize=11)
    with replace_file(path, "wb") as file:
        figure.savefig(file, dpi=130, format="png")

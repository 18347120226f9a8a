"""Draws the robustness curves of transferred policies, and strips of pictures of their episodes."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import mujoco
import numpy as np
from matplotlib.axes import Axes

from envs.vision.rgbd import open_renderer
from experiments.transfer.episode import MeanAction, episode_rngs, run_episode
from experiments.transfer.robots.base import Robot
from hgail_jax.io.files import replace_file

_COLUMNS = 4  # of panels
_SIZE = (240, 240)  # height and width of a picture, pixels
_DISTANCE, _AZIMUTH, _ELEVATION = 1.25, 140.0, -20.0  # of the camera: metres, degrees, degrees


def draw_sweep(path: Path, rows: Sequence[Mapping[str, Any]], axes: Mapping[str, str]) -> None:
    """Writes a PNG of the success rate against each quantity, with 95 % intervals: a line for each robot and task.

    Args:
      path: where to.
      rows: the points of `studies.sweep`, as measured.
      axes: a panel for each quantity, with the label of its x axis.

    """
    height = math.ceil(len(axes) / _COLUMNS)
    figure, grid = plt.subplots(
        height, _COLUMNS, figsize=(15, 3 * height), sharey=True, squeeze=False, constrained_layout=True
    )
    legend: list[str] = []
    for panel, (quantity, label) in zip(grid.flat, axes.items(), strict=False):
        lines = _lines(rows, quantity)
        _draw_lines(panel, lines)
        panel.set(xlabel=label, ylim=(-0.03, 1.03))
        panel.grid(alpha=0.3)
        panel.spines[["top", "right"]].set_visible(False)
        if lines and list(lines) != legend:  # the panels of disturbances share one
            legend = list(lines)
            panel.legend(fontsize=8)
    for panel in grid[:, 0]:
        panel.set_ylabel("success rate")
    for panel in grid.flat[len(axes) :]:
        panel.set_axis_off()
    with replace_file(path, "wb") as file:
        figure.savefig(file, dpi=90, format="png")
    plt.close(figure)


def draw_strip(path: Path, episodes: Sequence[tuple[Robot, MeanAction, Sequence[int]]], seed: int) -> None:
    """Writes a PNG with a row of pictures for each episode.

    Args:
      path: where to.
      episodes: robot, policy, and indices of the steps to show, in which the probe's steps count on.
      seed: of the starts.

    Raises:
      RuntimeError: MuJoCo cannot render here.

    """
    strips = []
    for robot, policy, steps in episodes:
        frames = _film(robot, policy, seed)
        strips.append(np.concatenate([frames[step] for step in steps], axis=1))
    with replace_file(path, "wb") as file:
        file.write(imageio.imwrite("<bytes>", np.concatenate(strips), extension=".png"))


def _lines(rows: Sequence[Mapping[str, Any]], quantity: str) -> dict[str, list[Mapping[str, Any]]]:
    """Returns the rows of each line of a quantity's panel, by the line's name in the legend."""
    lines: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        varied, _, line = row["quantity"].partition(", ")
        if varied == quantity:
            robot = row["robot"].partition(",")[0]
            lines.setdefault(", ".join(filter(None, (robot, row["task"], line))), []).append(row)
    return lines


def _draw_lines(panel: Axes, lines: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    for name, points in lines.items():
        rate, low, high = (
            np.array([point[column] for point in points]) for column in ("success_rate", "success_low", "success_high")
        )
        errors = np.maximum([rate - low, high - rate], 0.0)  # a rounded end may lie within the rate
        values = [point["value"] for point in points]
        panel.errorbar(values, rate, errors, label=name, marker="o", markersize=4, capsize=2, linewidth=1.5)


def _film(robot: Robot, policy: MeanAction, seed: int) -> list[np.ndarray]:
    """Returns a picture, `[height, width, 3]`, of an episode's start and one after each step."""
    start_rng, estimate_rng = episode_rngs(seed, 0)
    robot.reset(start_rng)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = robot.features()[:3] - robot.offset
    camera.distance, camera.azimuth, camera.elevation = _DISTANCE, _AZIMUTH, _ELEVATION
    frames: list[np.ndarray] = []
    with open_renderer(robot.model, *_SIZE) as renderer:
        run_episode(robot, policy, estimate_rng, watch=lambda: frames.append(_picture(renderer, robot, camera)))
    return frames


def _picture(renderer: mujoco.Renderer, robot: Robot, camera: mujoco.MjvCamera) -> np.ndarray:
    robot.model.site(robot.marker).pos = robot.target() - robot.offset
    mujoco.mj_kinematics(robot.model, robot.data)
    renderer.update_scene(robot.data, camera)
    return renderer.render()

"""Draws the robustness curves of transferred policies, and strips of pictures of their episodes."""

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from matplotlib.axes import Axes

from experiments.figures import style_axes, write_figure
from experiments.transfer.conditions import MeanAction
from experiments.transfer.episode import episode_rngs, run_episode
from experiments.transfer.robots.base import Robot
from hgail_envs.vision.rgbd import open_renderer
from hgail_jax.io.files import replace_file

_COLUMNS = 4  # of panels
_STYLES = ("-", "--", ":", "-.")  # of lines, by policy
_SIZE = (240, 240)  # height and width of a picture, pixels
_DISTANCE, _AZIMUTH, _ELEVATION = 1.25, 140.0, -20.0  # of the camera: metres, degrees, degrees


def draw_sweep(path: Path, rows: Sequence[Mapping[str, Any]], axes: Mapping[str, str]) -> None:
    """Writes a PNG of the success rate against each quantity, with 95 % intervals.

    Args:
      path: of the PNG.
      rows: the points of the sweep, as measured; each task and quantity has a panel, each robot a colour, each policy a
        style.
      axes: the label of the x axis for each quantity.

    """
    panels: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    for row in sorted(rows, key=lambda row: tasks.index(row["task"])):
        panels.setdefault((row["task"], row["quantity"].partition(", ")[0]), []).append(row)
    colours = {name: f"C{index}" for index, name in enumerate(dict.fromkeys(map(_acting, rows)))}
    styles = dict(
        zip(dict.fromkeys(row.get("policy", "plain") for row in rows), itertools.cycle(_STYLES), strict=False)
    )
    height = math.ceil(len(panels) / _COLUMNS)
    figure, grid = plt.subplots(
        height, _COLUMNS, figsize=(15, 3 * height), sharey=True, squeeze=False, constrained_layout=True
    )
    drawn: dict[str, Any] = {}
    for panel, ((task, quantity), points) in zip(grid.flat, panels.items(), strict=False):
        for name, line in _lines(points).items():
            drawn[name] = _draw_line(panel, line, colours[_acting(line[0])], styles[line[0].get("policy", "plain")])
        panel.set(xlabel=axes[quantity], title=task, ylim=(-0.03, 1.03))
        panel.xaxis.label.set_size(8)
        style_axes(panel)
    for panel in grid[:, 0]:
        panel.set_ylabel("success rate")
    for panel in grid.flat[len(panels) :]:
        panel.set_axis_off()
    figure.legend(drawn.values(), drawn.keys(), loc="outside lower center", ncols=_COLUMNS, fontsize=8)
    write_figure(figure, path, dpi=90)


def draw_strip(path: Path, episodes: Sequence[tuple[Robot, MeanAction, Sequence[int]]], seed: int) -> None:
    """Writes a PNG with a row of pictures for each episode.

    Args:
      path: of the PNG.
      episodes: robot, policy, and indices of the steps to show, counted on through the lift test.
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


def _acting(row: Mapping[str, Any]) -> str:
    """Returns the robot of a row, with the option of the line if there is one; each has a colour."""
    robot, option = row["robot"].partition(",")[0], row["quantity"].partition(", ")[2]
    return f"{robot}, {option}" if option else robot


def _lines(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Returns the rows of each line of a panel, by the line's name in the legend."""
    lines: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        lines.setdefault(f"{_acting(row)}, {row.get('policy', 'plain')}", []).append(row)
    return lines


def _draw_line(panel: Axes, points: Sequence[Mapping[str, Any]], colour: str, style: str) -> Any:
    rate, low, high = (
        np.array([point[column] for point in points]) for column in ("success_rate", "success_low", "success_high")
    )
    errors = np.maximum([rate - low, high - rate], 0.0)  # a rounded end may lie within the rate
    values = [point["value"] for point in points]
    return panel.errorbar(values, rate, errors, color=colour, linestyle=style, marker="o", markersize=4, capsize=2)


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
    mujoco.mj_kinematics(robot.model, robot.data)
    robot.data.site(robot.marker).xpos = robot.target() - robot.offset
    renderer.update_scene(robot.data, camera)
    return renderer.render()

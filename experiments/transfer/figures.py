"""Draws the robustness curves of transferred policies, and strips of pictures of their episodes."""

from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as imageio
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import mujoco
import numpy as np

from envs import find_class
from envs.vision.rgbd import open_renderer
from experiments.transfer.episode import Policy, Robot, run_episode
from hgail_jax.io.files import replace_file

_PANELS = {
    "noise": "noise of the target's position (m, σ of each coordinate)",
    "offset x": "constant offset in x (m)",
    "offset y": "constant offset in y (m), along which the hand closes",
    "offset z": "constant offset in z (m)",
    "delay": "delay of actions (steps)",
    "stride": "length of a step, times the trained one",
    "slowdown": "time of an action, times the trained one",
}
_SIZE = (240, 240)  # height, width of a picture
_VIEW = {"distance": 1.25, "azimuth": 140.0, "elevation": -20.0}


def draw_curves(path: Path, rows: Sequence[dict]) -> None:
    """Writes a PNG of the success rate against each quantity, with 95 % intervals: a line for each robot and task.

    Args:
      path: where to.
      rows: of `transfer_studies.sweep`, as measured.

    """
    figure, axes = plt.subplots(2, 4, figsize=(15, 6), sharey=True, constrained_layout=True)
    for axis, (quantity, label) in zip(axes.flat, _PANELS.items(), strict=False):
        lines: dict[str, list[dict]] = {}
        for row in rows:
            kind, _, variant = row["quantity"].partition(", ")
            if kind == quantity:
                name = f"{row['robot'].split(',')[0].split(' ')[0]}, {row['task']}{', ' + variant if variant else ''}"
                lines.setdefault(name, []).append(row)
        for name, points in lines.items():
            values = [point["value"] for point in points]
            rate = np.array([point["success_rate"] for point in points])
            low, high = (np.array([point[end] for point in points]) for end in ("success_low", "success_high"))
            errors = np.maximum([rate - low, high - rate], 0.0)
            axis.errorbar(values, rate, errors, label=name, marker="o", markersize=4, capsize=2, linewidth=1.5)
        axis.set(xlabel=label, ylim=(-0.03, 1.03))
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    for axis in axes[:, 0]:
        axis.set_ylabel("success rate")
    for axis in (axes[0, 0], axes[1, 2]):
        if axis.has_data():
            axis.legend(fontsize=8)
    axes[1, 3].set_axis_off()
    with replace_file(path, "wb") as file:
        figure.savefig(file, dpi=90, format="png")
    plt.close(figure)


def draw_strip(path: Path, episodes: Sequence[tuple[Robot, Policy, Sequence[int]]], seed: int) -> list[bool]:
    """Writes a PNG with a row of pictures for each episode; returns which were successes.

    Args:
      path: where to.
      episodes: robot, policy, and the steps to show; the probe's steps count on.
      seed: of the starts.

    Raises:
      RuntimeError: MuJoCo cannot render here.

    """
    strips, outcomes = [], []
    for robot, policy, steps in episodes:
        start, error = np.random.default_rng((seed, 0)).spawn(2)
        robot.reset(start)
        centre = robot.features()[:3] - robot.offset
        frames: list[np.ndarray] = []
        with open_renderer(robot.model, *_SIZE) as renderer:
            outcome = run_episode(robot, policy, error, watch=lambda: frames.append(_picture(renderer, robot, centre)))  # noqa: B023
        strips.append(np.concatenate([frames[step] for step in steps], axis=1))
        outcomes.append(bool(outcome.success))
    with replace_file(path, "wb") as file:
        file.write(imageio.imwrite("<bytes>", np.concatenate(strips), extension=".png"))
    return outcomes


def last_step(task: str) -> int:
    """Returns the number of the last picture of an episode, probe included."""
    kind = find_class(task)
    return kind.episode_length + kind.probe_length


def _picture(renderer: mujoco.Renderer, robot: Robot, centre: np.ndarray) -> np.ndarray:
    robot.model.site(robot.marker).pos = robot.target() - robot.offset
    mujoco.mj_kinematics(robot.model, robot.data)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = centre
    camera.distance, camera.azimuth, camera.elevation = _VIEW["distance"], _VIEW["azimuth"], _VIEW["elevation"]
    renderer.update_scene(robot.data, camera)
    return renderer.render()

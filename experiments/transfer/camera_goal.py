"""Target positions from cameras, as a `Localiser` estimates them at the start of an episode."""

import contextlib
from collections.abc import Sequence

import mujoco
import numpy as np

from experiments.localisation.keypoint_network import load_detector
from experiments.localisation.localiser import TILTED, Localiser, Noise, overhead
from experiments.paths import WEIGHTS
from experiments.transfer.conditions import Estimate
from experiments.transfer.robots.base import Robot
from hgail_envs.vision.rgbd import open_renderer


def check_rendering() -> None:
    """Raises a RuntimeError if MuJoCo cannot render here."""
    open_renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 1, 1).close()


def camera_estimate(robot: Robot, localiser: Localiser) -> Estimate:
    """Returns the estimate that a localiser makes of the target in a robot's scene.

    It uses the true position only to place the red ball that makes a goal of reach visible. The estimate raises
    `TargetNotSeenError` if no camera sees the target.
    """

    def estimate(position: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        marker = position - robot.offset if robot.task == "reach" else None
        return localiser(robot.model, robot.data, rng, marker) + robot.offset

    return estimate


def overhead_estimate(
    robot: Robot,
    stack: contextlib.ExitStack,
    views: Sequence[tuple[float, float]] = TILTED,
    noise: Noise | None = None,
) -> Estimate:
    """Returns the estimate of cameras over the workspace and the repository's detector.

    Args:
      robot: the robot, which is reset to find its gripper's start.
      stack: closes the renderer.
      views: of the cameras, see `overhead`.
      noise: of the cameras; None for exact ones.

    """
    robot.reset(np.random.default_rng(0))
    start = robot.features()[:3] - robot.offset
    cameras = overhead(start, views=views)
    localiser = stack.enter_context(Localiser(cameras, load_detector(WEIGHTS), noise, cube=robot.cube))
    return camera_estimate(robot, localiser)

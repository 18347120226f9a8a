"""Tells a transferred policy where cameras see the target: the estimate that `Localiser` makes at the start."""

import contextlib

import numpy as np

from envs.vision.rgbd import open_renderer
from experiments.localisation.__main__ import WEIGHTS
from experiments.localisation.keypoint_network import load_detector
from experiments.localisation.localiser import Localiser, overhead
from experiments.transfer.episode import Estimate, Robot


def seen(robot: Robot, localiser: Localiser) -> Estimate:
    """Returns the estimate that asks a localiser; the true position only places the red ball of reach.

    The estimate raises `TargetNotSeenError` where no camera sees the target.
    """

    def estimate(position: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        marker = position - robot.offset if robot.task == "reach" else None
        return localiser(robot.model, robot.data, rng, marker) + robot.offset

    return estimate


def from_cameras(robot: Robot, stack: contextlib.ExitStack) -> Estimate:
    """Returns the estimate of two exact cameras over the robot's workspace and the detector of the repository.

    Args:
      robot: is reset, to find out where its gripper starts.
      stack: closes the renderer.

    Raises:
      RuntimeError: MuJoCo cannot render here.

    """
    open_renderer(robot.model, 1, 1).close()
    robot.reset(np.random.default_rng(0))
    start = robot.features()[:3] - robot.offset
    return seen(robot, stack.enter_context(Localiser(overhead(start), load_detector(WEIGHTS), cube=robot.cube)))

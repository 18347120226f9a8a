"""Target positions from cameras, as a `Localiser` estimates them."""

import contextlib
import itertools
from collections.abc import Sequence

import mujoco
import numpy as np

from experiments.localisation.keypoint_network import load_detector
from experiments.localisation.localiser import TILTED, Localiser, Noise, TargetNotSeenError, overhead
from experiments.paths import WEIGHTS
from experiments.transfer.conditions import Estimate, Look
from experiments.transfer.robots.base import Robot
from hgail_envs.vision.rgbd import open_renderer

LOOK_EVERY = 5
"""Steps from one look at a tracked cube to the next: pictures of an arm cost more than its physics."""


def check_rendering() -> None:
    """Raises a RuntimeError if MuJoCo cannot render here."""
    open_renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 1, 1).close()


def camera_estimate(robot: Robot, localiser: Localiser) -> Estimate:
    """Returns the estimate that a localiser makes of the target in a robot's scene.

    It uses the true position only to place the red ball that makes a goal of reach visible. A tracked cube is looked at
    every `LOOK_EVERY` steps, each time with new noise; in between, and if no camera sees it, its last estimate stays.
    The first look raises `TargetNotSeenError` if no camera sees the target: a robot that waits would never see it.
    """

    def begin(rng: np.random.Generator) -> Look:
        steps, seen_at = itertools.count(), list[np.ndarray]()

        def look(position: np.ndarray) -> np.ndarray:
            if next(steps) % LOOK_EVERY == 0:
                marker = position - robot.offset if robot.task == "reach" else None
                try:
                    seen_at.append(localiser(robot.model, robot.data, rng, marker) + robot.offset)
                except TargetNotSeenError:
                    if not seen_at:
                        raise
            return seen_at[-1]

        return look

    return begin


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

"""Sources of the target's position in table 4, by name: the simulator, or RGB-D cameras over the workspace.

A camera sees the target if nothing is before it; the scene is not rendered. Of a target that it sees it measures pixel
and depth, of which the paper's Eq. 8 makes a position. Their errors and those of its calibration are drawn anew with
each look. The estimate is the mean over the cameras that see the target.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from experiments.transfer.camera import Camera, look_at
from experiments.transfer.conditions import TASKS, Estimate, Look, NoisyEstimate
from experiments.transfer.robots.base import Robot

LOOK_EVERY = 5
"""Steps from one look at a tracked cube to the next."""

TILTED = ((90.0, 55.0), (-30.0, 55.0))
"""Azimuth about z, from x, and elevation of two cameras, degrees; an arm hides a cube from at most one of them."""
ABOVE = ((0.0, 65.0),)
"""Azimuth and elevation of a single camera, opposite the robot."""

_DISTANCE = 1.0  # metres from the middle of the workspace
_BELOW_START = 0.05  # metres from the gripper's start down to the middle of the workspace
_FOVY, _PIXELS = 34.0, 128  # degrees, vertical field of view; every goal of reach is in the picture


class TargetNotSeenError(LookupError):
    """No camera sees the target."""


@dataclasses.dataclass(frozen=True)
class CameraNoise:
    """Standard deviations of a real camera's errors."""

    pixel: float = 0.0
    """Standard deviation of u and v, pixels."""
    depth: float = 0.0
    """Standard deviation of the depth, metres."""
    rotation: float = 0.0
    """Standard deviation of the calibrated orientation, about each of the camera's axes, degrees."""
    translation: float = 0.0
    """Standard deviation of the calibrated position, along each axis, metres."""


CALIBRATED = CameraNoise(pixel=1.0, depth=0.003, rotation=0.25, translation=0.002)
"""Noise of a common RGB-D camera at a metre, after a careful calibration."""


def overhead(start: np.ndarray, views: Sequence[tuple[float, float]] = TILTED) -> tuple[Camera, ...]:
    """Returns cameras that look down at the workspace.

    Args:
      start: `[3]`, the gripper's start, metres, world frame.
      views: azimuth and elevation of each, degrees, as `TILTED` has them.
    """
    middle = np.asarray(start, float) - [0.0, 0.0, _BELOW_START]
    cameras = []
    for azimuth, elevation in np.radians(views):
        direction = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        cameras.append(look_at(middle + _DISTANCE * np.array(direction), middle, _FOVY, _PIXELS, _PIXELS))
    return tuple(cameras)


def sees(robot: Robot, camera: Camera, target: np.ndarray) -> bool:
    """Returns whether nothing of a robot's scene is between a camera and a target, `[3]`, metres, world frame."""
    hit = np.full(1, -1, np.int32)
    ray = target - camera.position  # distances are multiples of its length
    distance = mujoco.mj_ray(robot.model, robot.data, camera.position, ray, None, True, -1, hit)
    of_cube = robot.task != "reach" and hit[0] == mujoco.mj_name2id(robot.model, mujoco.mjtObj.mjOBJ_GEOM, robot.cube)
    return bool(of_cube or distance < 0.0 or distance > 1.0)  # negative where it hits nothing


def measure(camera: Camera, target: np.ndarray, noise: CameraNoise, rng: np.random.Generator) -> np.ndarray:
    """Returns a camera's estimate of a target that it sees, both `[3]`, metres, world frame."""
    pixel, depth = camera.to_pixels(target)
    rotation = np.radians(noise.rotation) * rng.standard_normal(3)
    calibrated = camera.moved(rotation, noise.translation * rng.standard_normal(3))
    noisy = pixel + noise.pixel * rng.standard_normal(2)
    return calibrated.to_world(noisy, depth + noise.depth * rng.standard_normal())


def camera_estimate(
    robot: Robot, views: Sequence[tuple[float, float]] = TILTED, noise: CameraNoise | None = None
) -> Estimate:
    """Returns the estimate of cameras over the workspace.

    A tracked cube is looked at every `LOOK_EVERY` steps; in between, and if no camera sees it, its last estimate stays.
    The first look raises `TargetNotSeenError` if no camera sees the target: a robot that waits would never see it.

    Args:
      robot: reset here, to find its gripper's start.
      views: of the cameras, see `overhead`.
      noise: of the cameras; None for exact ones.
    """
    robot.reset(np.random.default_rng(0))
    cameras, exact = overhead(robot.features()[:3] - robot.offset, views), CameraNoise()

    def begin(rng: np.random.Generator) -> Look:
        steps, estimates = itertools.count(), list[np.ndarray]()

        def look(position: np.ndarray) -> np.ndarray:
            if next(steps) % LOOK_EVERY == 0:
                target = position - robot.offset
                seen = [measure(each, target, noise or exact, rng) for each in cameras if sees(robot, each, target)]
                if seen:
                    estimates.append(np.mean(seen, axis=0) + robot.offset)
                elif not estimates:
                    raise TargetNotSeenError(f"none of {len(cameras)} cameras sees the target")
            return estimates[-1]

        return look

    return begin


EXACT = "exact"
GOAL_SOURCES: dict[str, Callable[[Robot], Estimate]] = {
    EXACT: lambda robot: NoisyEstimate(),
    "camera": camera_estimate,
    "noisy-cameras": functools.partial(camera_estimate, noise=CALIBRATED),
    "one-camera": functools.partial(camera_estimate, views=ABOVE),
    "one-noisy-camera": functools.partial(camera_estimate, views=ABOVE, noise=CALIBRATED),
}
"""Makers of the estimate for a robot."""


def check_source(source: str, task: str) -> None:
    """Raises a ValueError if cameras cannot see the task's target."""
    seen = [name for name, each in TASKS.items() if each.seen_by_cameras]
    if source != EXACT and task not in seen:
        raise ValueError(f"cameras cannot see the target of {task!r}; they can of {', '.join(seen)}")


def stage(source: str) -> str:
    """Returns the entry of a goal source in table 4's column `stage`.

    >>> stage("camera")
    'camera goal'
    """
    return f"{source} goal"

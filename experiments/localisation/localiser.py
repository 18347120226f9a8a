"""Estimates the target's position from pictures of RGB-D cameras, as a real robot would have to.

The target is the cube, painted red, or for reach a red ball at the goal (`MARKER_RADIUS`), which only the cameras see.
Each camera takes a picture at the episode's start, in which a detector finds the pixel at the target's middle. The
paper's Eq. 8 turns pixel and depth into a point on the surface, from which the target's known size leads to its centre.
The estimate is the mean over the cameras that agree.

    localiser = Localiser(overhead(gripper_start), detect=load_detector(WEIGHTS), noise=Noise(pixel=1.0))
    position = localiser(model, data, rng)                 # the cube's centre, [3], metres, world frame
    position = localiser(model, data, rng, marker=goal)    # the ball's, put at `goal`

`model` is any scene with a z axis that points up and a geom that is the cube; its kinematics must be computed.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Iterable, Sequence

import mujoco
import numpy as np
from scipy import ndimage

from hgail_envs.fetch.grasp import CUBE_WIDTH
from hgail_envs.vision.camera import Camera, look_at
from hgail_envs.vision.rgbd import Photographer, Picture, Stage, add_shape

MARKER_RADIUS = 0.02
"""Metres, radius of the ball that marks a goal in the air."""
RED = np.array([0.85, 0.08, 0.08, 1.0])
"""The target's colour, RGBA."""
PIXELS = 128
"""Width and height of the pictures."""

TILTED = ((90.0, 55.0), (-30.0, 55.0))
"""Azimuth about z, from x, and elevation of two cameras, degrees; an arm hides a cube from at most one of them."""
ABOVE = ((0.0, 65.0),)
"""Azimuth and elevation of a single camera over the workspace, opposite the robot. The detector learnt from pictures of
the two cameras, and finds fewer cubes from straight above."""

_DISTANCE = 1.0  # metres from the middle of the workspace
_BELOW_START = 0.05  # metres from the gripper's start down to the middle of the workspace
_FOVY = 34.0  # degrees, vertical field of view; every goal of reach is in the picture

_AGREEMENT = 0.03  # metres, most distance from the first estimate of those averaged with it

_LEAST_REDNESS = 0.5  # (red - the larger of green and blue) / red
_LEAST_RED = 50  # of 255
_LEAST_AREA = 12  # pixels
_HIGHEST_FRACTION = 0.1  # fraction of the red pixels that is taken to be on the cube's top face
_TOP = 0.005  # metres below those that still count as the top face


class TargetNotSeenError(LookupError):
    """No camera sees the target."""


@dataclasses.dataclass(frozen=True)
class Noise:
    """Standard deviations of a real camera's errors, drawn anew for each picture; at least 0.

    Raises:
      ValueError: a value is negative or not finite.

    """

    pixel: float = 0.0
    """Standard deviation of u and v, pixels."""
    depth: float = 0.0
    """Standard deviation of the depth, metres."""
    rotation: float = 0.0
    """Standard deviation of the calibrated orientation, about each of the camera's axes, degrees."""
    translation: float = 0.0
    """Standard deviation of the calibrated position, along each axis, metres."""

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not 0.0 <= value < np.inf:
                raise ValueError(f"{name} noise is {value}; it must be a number of at least 0")


@dataclasses.dataclass(frozen=True)
class Detection:
    """Position in a picture of the middle of the cube's top face, or of the ball."""

    pixel: np.ndarray
    """`[2]`: (u, v)."""
    score: float
    """Score, larger for a target that is seen better; comparable between pictures, not between detectors."""


@dataclasses.dataclass(frozen=True)
class Sighting:
    """A detection, the picture that it is in, and the true pose of its camera."""

    detection: Detection
    picture: Picture
    camera: Camera


CALIBRATED = Noise(pixel=1.0, depth=0.003, rotation=0.25, translation=0.002)
"""Noise of a common RGB-D camera at a metre, after a careful calibration."""

Detector = Callable[[Picture, Camera, bool], Detection | None]
"""Finds the cube in a camera's picture, or the ball if the boolean is set; None if not found."""


def overhead(
    start: np.ndarray, pixels: int = PIXELS, views: Sequence[tuple[float, float]] = TILTED
) -> tuple[Camera, ...]:
    """Returns cameras that look down at the workspace, by default two from different sides of the arm.

    Args:
      start: `[3]`, the gripper's start, metres, world frame.
      pixels: width and height of the pictures.
      views: azimuth and elevation of each, degrees, as `TILTED` has them.

    """
    middle = np.asarray(start, float) - [0.0, 0.0, _BELOW_START]
    cameras = []
    for azimuth, elevation in np.radians(views):
        direction = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        cameras.append(look_at(middle + _DISTANCE * np.array(direction), middle, _FOVY, pixels, pixels))
    return tuple(cameras)


def detect_colour(picture: Picture, camera: Camera, marker: bool) -> Detection | None:
    """Finds the centroid of the largest red patch; of a cube, that of the pixels whose depth puts them on its top."""
    rgb = picture.rgb.astype(float)
    red = rgb[..., 0]
    mask = (red >= _LEAST_RED) & (red - rgb[..., 1:].max(axis=-1) >= _LEAST_REDNESS * red)
    patches, count = ndimage.label(mask)
    areas = np.bincount(patches.ravel())[1:]
    if not count or areas.max() < _LEAST_AREA:
        return None
    pixels = np.argwhere(patches == 1 + areas.argmax())[:, ::-1] + 0.5
    if not marker:
        heights = camera.to_world(pixels, read_depth(picture.depth, pixels))[:, 2]
        pixels = pixels[heights >= np.quantile(heights, 1.0 - _HIGHEST_FRACTION) - _TOP]
    return Detection(pixels.mean(axis=0), float(areas.max()))


def read_depth(depth: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Returns the depths, `[...]`, at pixels (u, v), `[..., 2]`, interpolated in an image, `[height, width]`.

    >>> read_depth(np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[0.5, 0.5], [1.0, 1.0], [0.5, 1.25]])).tolist()
    [1.0, 2.5, 2.5]
    """
    columns, rows = np.reshape(pixels, (-1, 2)).T - 0.5
    read = ndimage.map_coordinates(depth.astype(float), [rows, columns], order=1, mode="nearest")
    return read.reshape(np.shape(pixels)[:-1])


def surface_to_centre(camera: Camera, surface: np.ndarray, marker: bool) -> np.ndarray:
    """Returns the target's centre, `[3]`, from a point on its surface, `[3]`; metres, world frame.

    The point is the middle of the cube's top face, or the one where the ray to the ball's centre meets the ball.
    """
    if marker:
        ray = surface - camera.position
        return surface + MARKER_RADIUS * ray / np.linalg.norm(ray)
    return surface - [0.0, 0.0, CUBE_WIDTH / 2]


def estimate(
    pixel: np.ndarray, depth: np.ndarray, camera: Camera, marker: bool, noise: Noise, rng: np.random.Generator
) -> np.ndarray:
    """Returns the target's centre, `[3]`, from its pixel, `[2]`, and a depth image, with noise on all measurements."""
    noisy = pixel + noise.pixel * rng.standard_normal(2)
    distance = read_depth(depth, noisy) + noise.depth * rng.standard_normal()
    rotation = np.radians(noise.rotation) * rng.standard_normal(3)
    calibrated = camera.moved(rotation, noise.translation * rng.standard_normal(3))
    return surface_to_centre(calibrated, calibrated.to_world(noisy, distance), marker)


def sight(pictures: Iterable[tuple[Picture, Camera]], detect: Detector, marker: bool) -> list[Sighting]:
    """Returns a detector's sightings of the ball, or else the cube, in pictures of one scene, highest score first."""
    found = [Sighting(detection, *each) for each in pictures if (detection := detect(*each, marker)) is not None]
    return sorted(found, key=lambda sighting: sighting.detection.score, reverse=True)


def locate(sightings: Sequence[Sighting], marker: bool, noise: Noise, rng: np.random.Generator) -> np.ndarray:
    """Returns the target's centre, `[3]`, metres, world frame: the mean of the estimates that agree with the first.

    Args:
      sightings: from `sight`, at least one.
      marker: true if the target is the ball.
      noise: drawn for each camera.
      rng: source of the noise.

    """
    estimates = np.array(
        [estimate(each.detection.pixel, each.picture.depth, each.camera, marker, noise, rng) for each in sightings]
    )
    agree = np.linalg.norm(estimates - estimates[0], axis=1) <= _AGREEMENT
    return estimates[agree].mean(axis=0)


def paint(model: mujoco.MjModel, geom: str, rgba: np.ndarray = RED) -> Stage:
    """Returns a stage that paints the geom `geom` of the model.

    Raises:
      ValueError: the model has no such geom.

    """
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, geom)
    if number < 0:
        raise ValueError(f"the scene has no geom {geom!r}")

    def stage(scene: mujoco.MjvScene) -> None:
        for shown in scene.geoms[: scene.ngeom]:
            if shown.objtype == mujoco.mjtObj.mjOBJ_GEOM and shown.objid == number:
                shown.rgba, shown.matid = rgba, -1

    return stage


def ball(position: np.ndarray, rgba: np.ndarray = RED) -> Stage:
    """Returns a stage that puts the ball at a position, `[3]`, metres, world frame."""

    def stage(scene: mujoco.MjvScene) -> None:
        add_shape(scene, mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, MARKER_RADIUS), position, rgba)

    return stage


class Localiser(contextlib.AbstractContextManager):
    """Estimates the target's position from pictures; see the module. Use it in one thread, and close it.

    Args:
      cameras: their true poses; all pictures have one size.
      detect: finds the target in a picture.
      noise: of the measurements and the cameras' calibrated poses; None for exact ones.
      cube: name of the cube's geom.

    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        detect: Detector = detect_colour,
        noise: Noise | None = None,
        cube: str = "cube",
    ) -> None:
        self._cameras, self._detect, self._cube = cameras, detect, cube
        self._noise = noise or Noise()
        self._photographer: Photographer | None = None
        self._model: mujoco.MjModel | None = None

    def __call__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        rng: np.random.Generator,
        marker: np.ndarray | None = None,
    ) -> np.ndarray:
        """Returns the centre of the cube, or of the ball that is put at `marker`, `[3]`, metres, world frame.

        Raises:
          TargetNotSeenError: the detector finds the target in no picture.
          RuntimeError: MuJoCo cannot render here.
          ValueError: the model has no geom of the cube's name.

        """
        stage = paint(model, self._cube) if marker is None else ball(marker)
        photographer = self._open(model)
        pictures = ((photographer.shoot(data, camera, stage), camera) for camera in self._cameras)
        sightings = sight(pictures, self._detect, marker is not None)
        if not sightings:
            raise TargetNotSeenError(f"none of {len(self._cameras)} cameras sees the target")
        return locate(sightings, marker is not None, self._noise, rng)

    def _open(self, model: mujoco.MjModel) -> Photographer:
        if self._photographer is None or self._model is not model:
            self.close()
            self._photographer = Photographer(model, self._cameras[0].width, self._cameras[0].height)
            self._model = model
        return self._photographer

    def close(self) -> None:
        """Frees the renderer."""
        if self._photographer is not None:
            self._photographer.close()
            self._photographer = None

    def __exit__(self, *exception) -> None:
        self.close()

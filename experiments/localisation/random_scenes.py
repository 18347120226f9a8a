"""Labelled pictures of the Fetch scene with a target in the workspace, plain or with domain randomisation.

A plain scene is the project's own: its light, the arm at its start, cameras where `overhead` puts them. A randomised
one differs in light, colours, the arm's posture, the cameras' poses and the cube's yaw, and holds clutter: up to eight
shapes, some of them as red as the target, others of its shape in another colour. The target's position is drawn as the
tasks draw theirs.
"""

import contextlib
import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np
from matplotlib.colors import hsv_to_rgb
from scipy.spatial.transform import Rotation

from experiments.localisation.localiser import MARKER_RADIUS, RED, ball, overhead, paint, read_depth, surface_to_centre
from hgail_envs.fetch.arm import LEAST_DISTANCE, TABLE_HEIGHT, settle
from hgail_envs.fetch.grasp import CUBE_RANGE, CUBE_WIDTH
from hgail_envs.fetch.reach import GOAL_RANGE
from hgail_envs.scenes import load_scene
from hgail_envs.vision.camera import Camera
from hgail_envs.vision.rgbd import Photographer, Picture, Stage, add_shape

_AWAY = [0.0, 0.0, -1.0]  # metres, under the floor: the cube's position when the ball is the target
_MOST_CLUTTER = 8
_CLUTTER_RANGE = 0.22  # metres around the gripper's start, in the plane
_ARM = ("shoulder_pan", "shoulder_lift", "upperarm_roll", "elbow_flex", "forearm_roll", "wrist_flex", "wrist_roll")
_POSTURE = 0.06  # radians, standard deviation of each of the arm's joints from its start
_CAMERA_ROTATION, _CAMERA_TRANSLATION = 1.5, 0.02  # degrees and metres, standard deviations
_ZOOM = 0.03  # relative, standard deviation of the focal length
_CLOSE = 0.005  # metres, largest error of a pixel's depth that still shows the target
_BOX, _SPHERE, _CYLINDER, _ELLIPSOID = (
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID,
)
_SHAPES = (_BOX, _SPHERE, _CYLINDER, _ELLIPSOID)
_RED_SHAPES = {False: (_SPHERE, _CYLINDER), True: (_BOX, _CYLINDER)}  # unlike the cube, unlike the marker
_RED_FRACTION = 0.3  # of the clutter
_MOST_LIGHTS = 8


@dataclasses.dataclass(frozen=True)
class View:
    """Picture of a scene by one camera, with its label."""

    picture: Picture
    camera: Camera
    pixel: np.ndarray
    """`[2]`: (u, v) of the middle of the cube's top face, or of the ball; see `Detection`."""
    seen: bool
    """True if that pixel shows the target, which may be hidden or out of the picture."""


@dataclasses.dataclass(frozen=True)
class Sample:
    """A scene with a target, in the pictures of all cameras."""

    views: tuple[View, ...]
    position: np.ndarray
    """`[3]`: the target's centre, metres, world frame."""
    marker: bool
    """True if the target is the ball, false if it is the cube."""


class Studio(contextlib.AbstractContextManager):
    """Draws samples. Use it in one thread, and close it.

    Raises:
      RuntimeError: MuJoCo cannot render here.

    """

    def __init__(self) -> None:
        self.model = load_scene("fetch/grasp", visual=True)
        self.data = settle(self.model)
        self.start = self.data.site("grip").xpos.copy()
        self._settled = self.data.qpos.copy()
        self._cameras = overhead(self.start)
        self._photographer = Photographer(self.model, self._cameras[0].width, self._cameras[0].height)

    def __exit__(self, *exception) -> None:
        self.close()

    def close(self) -> None:
        """Frees the renderer."""
        self._photographer.close()

    def draw(self, rng: np.random.Generator, marker: bool, randomised: bool, cameras: int | None = 2) -> Sample:
        """Returns a random sample.

        Args:
          rng: source of randomness.
          marker: true if the target is the ball, false if it is the cube.
          randomised: true for a randomised scene, see the module.
          cameras: number of the two that take a picture; None is one of them at random.

        """
        position = self._place_target(rng, marker, randomised)
        colour = _reddish(rng) if randomised else RED
        stages = [ball(position, colour) if marker else paint(self.model, "cube", colour)]
        if randomised:
            stages += [_recolour(self.model, rng), _clutter(rng, self.start, position, marker), _light(rng)]
        chosen = [self._cameras[rng.integers(len(self._cameras))]] if cameras is None else self._cameras[:cameras]
        views = [
            self._view(_jitter(rng, camera) if randomised else camera, stages, position, marker) for camera in chosen
        ]
        return Sample(tuple(views), position, marker)

    def _place_target(self, rng: np.random.Generator, marker: bool, randomised: bool) -> np.ndarray:
        """Poses the arm, puts the target into the workspace, and returns the target's centre, `[3]`."""
        self.data.qpos[:] = self._settled
        if randomised:
            for joint in _ARM:
                self.data.joint(joint).qpos += _POSTURE * rng.standard_normal()
        width = GOAL_RANGE if marker else CUBE_RANGE
        while True:
            position = self.start + rng.uniform(-width, width, 3)
            if marker or np.linalg.norm(position[:2] - self.start[:2]) >= LEAST_DISTANCE:
                break
        cube = np.append(position[:2], TABLE_HEIGHT + CUBE_WIDTH / 2)
        yaw = rng.uniform(0, np.pi) if randomised else 0.0
        self.data.joint("cube").qpos[:] = [*(_AWAY if marker else cube), np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        return position if marker else cube

    def _view(self, camera: Camera, stages: Sequence[Stage], position: np.ndarray, marker: bool) -> View:
        """Takes a picture after the changes of `stages`, labelled with the target centred at `position`."""

        def stage(scene: mujoco.MjvScene) -> None:
            for change in stages:
                change(scene)

        picture = self._photographer.shoot(self.data, camera, stage)
        top = position if marker else np.add(position, [0.0, 0.0, CUBE_WIDTH / 2])
        pixel, _ = camera.to_pixels(top)
        return View(picture, camera, pixel, _is_seen(picture, camera, pixel, position, marker))


def _is_seen(picture: Picture, camera: Camera, pixel: np.ndarray, position: np.ndarray, marker: bool) -> bool:
    """Returns whether the depth at a pixel is the target's, and not that of an occluder."""
    surface = camera.to_world(pixel, read_depth(picture.depth, pixel))
    centre = surface_to_centre(camera, surface, marker)
    return bool(camera.contains(pixel) and np.linalg.norm(centre - position) < _CLOSE)


def _reddish(rng: np.random.Generator) -> np.ndarray:
    """Returns a random colour that `detect_colour` may take for the target's, `[4]`, RGBA."""
    return _rgba(rng.uniform(-0.03, 0.03), rng.uniform(0.8, 1.0), rng.uniform(0.6, 1.0))


def _rgba(hue: float, saturation: float, value: float) -> np.ndarray:
    return np.append(hsv_to_rgb([hue % 1.0, saturation, value]), 1.0)


def _not_red(rng: np.random.Generator) -> np.ndarray:
    """Returns a random colour of any other hue, `[4]`, RGBA."""
    return _rgba(rng.uniform(0.06, 0.92), rng.uniform(), rng.uniform(0.1, 1.0))


def _jitter(rng: np.random.Generator, camera: Camera) -> Camera:
    """Returns a camera with a slightly different pose and focal length."""
    turn = np.radians(_CAMERA_ROTATION) * rng.standard_normal(3)
    matrix = camera.matrix @ np.diag([*np.full(2, 1 + _ZOOM * rng.standard_normal()), 1.0])
    moved = camera.moved(turn, _CAMERA_TRANSLATION * rng.standard_normal(3))
    return dataclasses.replace(moved, matrix=matrix)


def _recolour(model: mujoco.MjModel, rng: np.random.Generator) -> Stage:
    """Paints a random half of the scene's geoms, the cube apart, in colours that are not red."""
    cube = model.geom("cube").id
    colours = {geom: _not_red(rng) for geom in range(model.ngeom) if geom != cube and rng.random() < 0.5}

    def stage(scene: mujoco.MjvScene) -> None:
        for shown in scene.geoms[: scene.ngeom]:
            if shown.objtype == mujoco.mjtObj.mjOBJ_GEOM and shown.objid in colours:
                shown.rgba, shown.matid = colours[shown.objid].astype(np.float32), -1

    return stage


def _clutter(rng: np.random.Generator, start: np.ndarray, target: np.ndarray, marker: bool) -> Stage:
    """Puts shapes on the table that do not touch the target."""
    shapes = []
    for _ in range(rng.integers(_MOST_CLUTTER + 1)):
        size = rng.uniform(0.012, 0.04, 3)
        place = np.append(start[:2] + rng.uniform(-_CLUTTER_RANGE, _CLUTTER_RANGE, 2), TABLE_HEIGHT + size[2])
        red = rng.random() < _RED_FRACTION
        kind = rng.choice(_RED_SHAPES[marker] if red else _SHAPES)
        if kind == _SPHERE:
            place[2] = TABLE_HEIGHT + size[0]
        elif kind == _CYLINDER:
            size[1] = size[2]
        colour = _reddish(rng) if red else _not_red(rng)
        turn = Rotation.from_euler("z", rng.uniform(0, np.pi)).as_matrix()
        if np.linalg.norm(place - target) > np.linalg.norm(size) + (MARKER_RADIUS if marker else CUBE_WIDTH):
            shapes.append((mujoco.mjtGeom(kind), size, place, colour, turn))

    def stage(scene: mujoco.MjvScene) -> None:
        for shape in shapes:
            add_shape(scene, *shape)

    return stage


def _light(rng: np.random.Generator) -> Stage:
    """Tints and dims every light, and turns all but the headlight to another direction from above."""
    tints = rng.uniform(0.75, 1.15, 3) * rng.uniform(0.5, 1.3, (_MOST_LIGHTS, 1))
    direction = np.append(rng.uniform(-0.8, 0.8, 2), -1.0)

    def stage(scene: mujoco.MjvScene) -> None:
        for light, tint in zip(scene.lights[: scene.nlight], tints, strict=False):
            light.ambient, light.diffuse = light.ambient * tint, light.diffuse * tint
            if not light.headlight:
                light.dir = direction / np.linalg.norm(direction)

    return stage

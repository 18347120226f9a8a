"""Scenes: a table and objects around a robot, as MJCF, and pictures of them.

They are found in a checkout and in an installed wheel alike, and one of a user's own beside the task's file.
"""

import contextlib
import inspect
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from hgail_envs.base import GoalEnv
from hgail_envs.vision.rendering import open_renderer

TABLE_HEIGHT = 0.4
"""Metres from the floor to the table's top, in every scene."""

_CAMERA_DISTANCE = 2.15  # in a scene's extent; the arm stays in the picture wherever it goes
_CAMERA_RISE = 0.06  # metres from a scene's centre to the picture's, for the elbow
_SIZE = (480, 640)  # height, width
VISUAL_GROUP = 2
"""Group of geoms that collide with nothing."""
HAND = ("palm", "right_pad", "left_pad")
"""Geoms of every robot, with which it touches a scene."""
_PARTS = ("room.xml", "cube.xml")  # parts of scenes, which are none themselves


def assets_directory() -> Path:
    """Returns the folder of the scenes: `hgail_envs/assets` in a wheel, `assets` of the repository in a checkout."""
    package = Path(__file__).resolve().parent
    installed = package / "assets"
    return installed if installed.is_dir() else package.parent.parent / "assets"


def find_scene(task: type[GoalEnv]) -> str:
    """Returns a task's scene: the name of one of the package, or the absolute path of a user's MJCF file.

    `GoalEnv.scene` is a path if it ends with `.xml`. A relative one is relative to the file of the class that sets it,
    or of a class without a file, as in a notebook, to the working folder.

    Raises:
      ValueError: there is no such scene.
    """
    owner = next(base for base in task.__mro__ if "scene" in vars(base))
    scene = str(vars(owner)["scene"])
    if scene.endswith(".xml"):
        path = (_folder_of(owner) / scene).resolve()
        if not path.is_file():
            raise ValueError(f"{owner.__name__}.scene is {scene!r}, and there is no file {path}")
        return str(path)
    names = sorted(path.stem for path in _scene_file("").parent.glob("*.xml") if path.name not in _PARTS)
    if scene not in names:
        file = "or name a file of your own, whose name ends with .xml"
        raise ValueError(f"{owner.__name__}.scene is {scene!r}; choose from {', '.join(names)}, {file}")
    return scene


def _scene_file(scene: str) -> Path:
    return Path(scene) if scene.endswith(".xml") else assets_directory() / "scenes" / f"{scene}.xml"


def _folder_of(owner: type) -> Path:
    try:
        return Path(inspect.getfile(owner)).parent
    except (TypeError, OSError):  # written in a notebook
        return Path.cwd()


def read_scene(scene: str, parts: Mapping[str, bytes]) -> mujoco.MjSpec:
    """Reads a scene, see `find_scene`, with the files of a robot that it includes, by their names there.

    A user's file may include the package's `room.xml` and `cube.xml`, unless files of these names lie beside it. Geoms
    that collide by `contype` or `conaffinity`, as in an MJCF that was made for another robot, get pairs with the hand.
    """
    path = _scene_file(scene)
    shared = {name: _scene_file(name[:-4]).read_bytes() for name in _PARTS if not (path.parent / name).exists()}
    with explained(scene):
        spec = mujoco.MjSpec.from_file(str(path), include={**shared, **parts})
    _pair_with_hand(spec)
    return spec


def _pair_with_hand(spec: mujoco.MjSpec) -> None:
    """Adds the pairs with the hand that a scene's colliding geoms lack; parts on joints then touch it alone."""
    there = {frozenset((pair.geomname1, pair.geomname2)) for pair in spec.pairs}
    for number, geom in enumerate(spec.geoms):
        if geom.group == VISUAL_GROUP or not (geom.contype or geom.conaffinity):
            continue
        geom.name = geom.name or f"geom-{number}"
        if not _is_on_free_joint(geom):  # what free bodies would touch without a pair stays an error
            geom.contype, geom.conaffinity = 0, geom.contype | geom.conaffinity
        for part in HAND:
            if frozenset((geom.name, part)) not in there:
                # No margin, which MJX-Warp refuses between boxes.
                slide, spin, roll = geom.friction
                contact = {"condim": geom.condim, "solref": geom.solref, "solimp": geom.solimp}
                friction = [slide, slide, spin, roll, roll]
                spec.add_pair(geomname1=geom.name, geomname2=part, friction=friction, **contact)


def _is_on_free_joint(geom: mujoco.MjsGeom) -> bool:
    root = geom.parent
    while root.name != "world" and root.parent.name != "world":
        root = root.parent
    return any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in root.joints)


@contextlib.contextmanager
def explained(scene: str) -> Iterator[None]:
    """Turns MuJoCo's errors, in several lines and without the file's name, into a ValueError of one line."""
    try:
        yield
    except ValueError as error:
        text = "; ".join(str(error).strip().splitlines())
        raise ValueError(text if scene in text else f"scene {scene}: {text}") from error


def check_names(model: mujoco.MjModel, scene: str, kind: str, *names: str) -> None:
    """Raises a ValueError for the first name that is of no `"joint"`, `"site"` or `"geom"` of a model."""
    count = getattr(model, {"joint": "njnt", "site": "nsite", "geom": "ngeom"}[kind])
    there = [getattr(model, kind)(index).name for index in range(count)]
    for name in names:
        if name not in there:
            raise ValueError(f"scene {scene} has no {kind} {name!r}; it has {', '.join(filter(None, there)) or 'none'}")


def check_contacts(model: mujoco.MjModel, scene: str) -> None:
    """Raises a ValueError for geoms that would touch without a `<pair>`, which buffers and friction do not know."""
    collides = (model.geom_contype[:, None] & model.geom_conaffinity[None]) != 0
    apart = model.geom_bodyid[:, None] != model.geom_bodyid[None]
    for first, second in np.argwhere((collides | collides.T) & apart)[:1]:
        names = [model.geom(int(index)).name or f"number {index}" for index in (first, second)]
        raise ValueError(
            f"scene {scene}: the geoms {' and '.join(names)} would touch without a <pair>; give them contype and"
            ' conaffinity "0", and a <pair> to those that are to touch'
        )


def without_visuals(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Returns a scene without what has no effect on the physics: cameras, and geoms that touch nothing."""
    for camera in list(spec.cameras):
        spec.delete(camera)
    for geom in [geom for geom in spec.geoms if geom.group == VISUAL_GROUP]:
        spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in [mesh for mesh in spec.meshes if mesh.name not in used]:  # they take long to compile
        spec.delete(mesh)
    return spec


def free_camera(model: mujoco.MjModel) -> mujoco.MjvCamera:
    """Returns the camera that shows the arm wherever it goes."""
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    camera.distance = _CAMERA_DISTANCE * model.stat.extent
    camera.lookat[2] += _CAMERA_RISE
    return camera


class SceneView:
    """Pictures of a task's scene in given poses, with the `render_mode` `"rgb_array"`; a ValueError if it has none."""

    def __init__(self, env: GoalEnv, render_mode: str | None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is {render_mode!r}; it must be None or 'rgb_array'")
        if render_mode is not None and env.robot is None:
            raise ValueError("the task has no scene to show")
        self._env = env
        self._renderer: mujoco.Renderer | None = None

    def picture(self, qpos: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Returns the scene with joints at `qpos` and the target at `goal`, `[480, 640, 3]`, uint8."""
        if self._renderer is None:
            self.model, self.data = open_scene(self._env)
            self._renderer, self._camera = open_renderer(self.model, *_SIZE), free_camera(self.model)
        pose(self.model, self.data, qpos, goal)
        self._renderer.update_scene(self.data, self._camera)
        return self._renderer.render()

    def __reduce__(self) -> tuple[Any, ...]:
        return SceneView, (self._env, None)

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None


def open_scene(env: GoalEnv) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Returns a task's scene with its visual geoms; the target's marker is hidden where a body is the target."""
    if env.robot is None:
        raise ValueError("the task has no scene to show")
    model = env.robot.load(visual=True)
    if env.target_body is not None:
        model.site("target").rgba[3] = 0.0
    return model, mujoco.MjData(model)


def pose(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray, goal: np.ndarray) -> None:
    """Poses a scene of `open_scene` for a picture, with the target's marker at `goal`, `[goal_size]`."""
    model.site("target").pos = goal[:3]
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)

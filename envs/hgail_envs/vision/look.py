"""How the look of a scene varies from one episode to the next: colours, light and cameras.

The sizes of a level are data. Each is a bound around the scene's own value; an episode draws uniformly within it.
"""

import dataclasses
from types import ModuleType
from typing import Any

import mujoco
import numpy as np

from hgail_envs.vision.things import THING


@dataclasses.dataclass(frozen=True)
class Look:
    """Bounds of an episode's look."""

    colour: float = 0.0
    """Of each channel of each colour, which are 0 to 1; see `_DISTINCT`."""
    brightness: float = 0.0
    """Of a light's strength, as a fraction."""
    light_turn: float = 0.0
    """Of a light's direction along each axis, as a fraction of its length."""
    camera_shift: float = 0.0
    """Of a camera's position along each axis of the world, metres."""
    camera_turn: float = 0.0
    """Of a camera's direction about each of its axes, radians."""
    zoom: float = 0.0
    """Of a camera's field of view, as a fraction."""
    shadows: float = 1.0
    """Fraction of the episodes in which lights cast shadows."""
    late: float = 0.0
    """Fraction of the episodes whose pictures show the state of an action before."""
    things: bool = False
    """Whether things stand around the table, see `hgail_envs.vision.things`."""


_VARIED = Look(colour=0.2, brightness=0.35, light_turn=0.4, camera_shift=0.01, camera_turn=0.02, zoom=0.02, shadows=0.5)
LOOKS = {
    "plain": Look(),
    # Camera, screen and paint turn a colour by .1 to .2; cubes of a stack or a tower keep within .15, less than half
    # of what is between them. The light of a room differs by a third from hour to hour. A light that turns by .4 of
    # its length along each axis does so by up to 43 degrees. A camera on a stand is put back to a centimetre and to a
    # degree, and its field of view known to 2 %. A lamp casts shadows and an overcast sky does not: a student that
    # had seen none predicted the position of push's cube to 1.2 cm without them, and to 2.7 cm with them.
    "varied": _VARIED,
    "shadowless": dataclasses.replace(_VARIED, shadows=0.0),
    # A room is not empty.
    "things": dataclasses.replace(_VARIED, things=True),
    # Another cube, table, arm and room: any colours. Light through a window or from a single lamp; a camera put back by
    # eye, to two centimetres and two degrees, and its field of view taken from a data sheet.
    "wide": Look(
        colour=1.0, brightness=0.6, light_turn=0.8, camera_shift=0.02, camera_turn=0.035, zoom=0.04, shadows=0.5
    ),
    # A camera at 30 pictures a second shows the state of 30 to 70 ms ago, an action is 40 ms.
    "late": dataclasses.replace(_VARIED, late=0.5),
    # Its blur is of the images, and so is the last part of "varied": they are in `hgail_jax.vision.augmentation`.
    "blurred": _VARIED,
    # The parts of "varied", each alone.
    "colours": Look(colour=0.2),
    "light": Look(brightness=0.35, light_turn=0.4),
    "shadows": Look(shadows=0.5),
    "cameras": Look(camera_shift=0.01, camera_turn=0.02, zoom=0.02),
    "image": Look(),
}
"""Looks by name."""
MARKER = "marker of the target"
"""Body of the ball that stands for a target that is seen."""
_DISTINCT = 0.15  # largest bound of the colour of the marker, and of the objects where there are several

FIELDS = ("geom_rgba", "mat_rgba", "light_diffuse", "light_dir", "light_castshadow", "cam_fovy")
"""Fields of the model that a look changes."""


def draws_of(model: mujoco.MjModel) -> int:
    """Returns how many numbers the draws of a look are."""
    return sum(int(np.prod(shape)) for shape in _shapes(model).values())


def _shapes(model: mujoco.MjModel) -> dict[str, tuple[int, ...]]:
    of_cameras = {"shift": (model.ncam, 3), "turn": (model.ncam, 3), "zoom": (model.ncam,)}
    of_lights = {"brightness": (model.nlight, 1), "light": (model.nlight, 3), "shadows": (model.nlight,)}
    return {"geom": (model.ngeom, 3), "mat": (model.nmat, 3)} | of_lights | of_cameras


def split_draws(model: mujoco.MjModel, draws: Any) -> dict[str, Any]:
    """Returns the draws, `[..., draws_of(model)]`, by what they vary, each `[...]` and its own shape."""
    ends = np.cumsum([int(np.prod(shape)) for shape in _shapes(model).values()])
    return {
        name: draws[..., end - int(np.prod(shape)) : end].reshape(*draws.shape[:-1], *shape)
        for end, (name, shape) in zip(ends, _shapes(model).items(), strict=True)
    }


def varied(model: mujoco.MjModel, look: Look, draws: Any, xp: ModuleType) -> dict[str, Any]:
    """Returns what a look changes, by its draws, `[..., draws_of(model)]` in [-1, 1]; the module `xp` computes.

    The leaves have the batch's axes in front. They are the `FIELDS` as they are to be, the `shift` of each camera in
    the world, `[..., ncam, 3]`, metres, and its `turn`, `[..., ncam, 3, 3]`, a rotation in the camera's own frame.
    """
    parts = split_draws(model, draws)

    def coloured(rgba: np.ndarray, offset: Any) -> Any:
        colour = xp.clip(rgba[:, :3] + offset, 0.0, 1.0)
        return xp.concatenate([colour, xp.broadcast_to(rgba[:, 3:], (*colour.shape[:-1], 1))], axis=-1)

    # A geom that has a material must keep its own colour, or that would count instead of the material's.
    bare = (model.geom_matid < 0)[:, None]
    direction = model.light_dir + look.light_turn * parts["light"]
    return {
        "geom_rgba": coloured(model.geom_rgba, _colour_bounds(model, look) * (parts["geom"] * bare)),
        "mat_rgba": coloured(model.mat_rgba, look.colour * parts["mat"]),
        "light_diffuse": model.light_diffuse * (1.0 + look.brightness * parts["brightness"]),
        "light_dir": direction / xp.sqrt(xp.square(direction).sum(axis=-1, keepdims=True)),
        "light_castshadow": model.light_castshadow & (parts["shadows"] <= 2.0 * look.shadows - 1.0),
        "cam_fovy": model.cam_fovy * (1.0 + look.zoom * parts["zoom"]),
        "shift": look.camera_shift * parts["shift"],
        "turn": _rotation(look.camera_turn * parts["turn"], xp),
    }


def _colour_bounds(model: mujoco.MjModel, look: Look) -> np.ndarray:
    """Returns the bounds of the geoms' colours, `[ngeom, 1]`: things may have any."""
    names = np.array([model.body(body).name for body in range(model.nbody)])
    objects = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    if len(objects) < 2:
        objects = objects[:0]
    distinct = np.isin(model.geom_bodyid, [*np.flatnonzero(names == MARKER), *objects])
    bounds = np.where(distinct, min(look.colour, _DISTINCT), look.colour)
    bounds[np.char.startswith(names, THING)[model.geom_bodyid]] = 1.0
    return bounds[:, None].astype(np.float32)  # as the draws are


def _rotation(angles: Any, xp: ModuleType) -> Any:
    """Returns the rotations, `[..., 3, 3]`, about x, then y, then z, by angles `[..., 3]`."""
    sin, cos = xp.sin(angles), xp.cos(angles)
    zero, one = xp.zeros_like(sin[..., 0]), xp.ones_like(sin[..., 0])

    def matrix(*rows: Any) -> Any:
        return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)

    (sx, sy, sz), (cx, cy, cz) = (xp.moveaxis(values, -1, 0) for values in (sin, cos))
    about_x = matrix((one, zero, zero), (zero, cx, -sx), (zero, sx, cx))
    about_y = matrix((cy, zero, sy), (zero, one, zero), (-sy, zero, cy))
    about_z = matrix((cz, -sz, zero), (sz, cz, zero), (zero, zero, one))
    return about_z @ about_y @ about_x

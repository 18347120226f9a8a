"""Pictures of a batch of scenes, rendered within a compiled program."""

import importlib.util
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from hgail_envs.base import GoalEnv
from hgail_envs.engines import resolve_impl
from hgail_envs.scenes import VISUAL_GROUP, explained
from hgail_envs.validation import check_count, check_name
from hgail_envs.vision.cameras import DEFAULT_CAMERAS, camera_ids
from hgail_envs.vision.look import LOOKS, MARKER, Look, draws_of
from hgail_envs.vision.opengl import OpenGLRenderer
from hgail_envs.vision.things import JOINTS, add_sliding_body, add_things, places_of_things
from hgail_envs.vision.warp_renderer import WarpRenderer

RENDERERS: dict[str, Callable[[mujoco.MjModel, list[int], int, Look, bool], Callable[..., jax.Array]]] = {
    "opengl": OpenGLRenderer,
    "warp": WarpRenderer,
}
"""Renderers by name: MuJoCo's own, called back on the host, and MuJoCo Warp's, made for an NVIDIA GPU."""
TARGETS = ("given", "seen")
"""How a policy with pictures learns where the target is: by the goal's numbers, or from the pictures alone."""
KINDS = {"colour": 3, "depth": 1}
"""Kinds of pictures, and how many numbers a pixel has."""
SIZE = 64
"""Edge of a picture unless another is given, pixels."""
_SMALLEST, _LARGEST = 16, 256


class Pictures:
    """What cameras of a task's scene see, in square pictures.

    Called with joint positions, `[..., joints]`, and the draws of the scenes' looks, `[..., draws]` in [-1, 1], it
    returns pictures `[..., cameras, size, size, 3]`, uint8: the upper row first, red first. It may be traced and
    batched. All scenes of a batch are rendered at once: a vmap around it, over seeds for instance, only makes the batch
    larger. The `renderer` is a name in `RENDERERS`, or `"auto"`: Warp's on an NVIDIA GPU.

    Pictures of the `kind` `"depth"` are `[..., cameras, size, size, 1]`: distances, see `hgail_envs.vision.depth`.

    The marker of a `target` that is `"seen"` is a ball in the pictures, unless the scene shows the goal without it. Its
    three coordinates follow the task's own joint positions. A target that is `"given"` is in no picture.

    Raises:
      ValueError: the task has no scene, the scene has no such camera, there is no such renderer, look or kind, or
        warp-lang is missing.
      RenderingError: MuJoCo cannot render here.
    """

    def __init__(
        self,
        env: GoalEnv,
        cameras: Sequence[str] = DEFAULT_CAMERAS,
        size: int = SIZE,
        renderer: str = "auto",
        look: str = "plain",
        target: str = "given",
        kind: str = "colour",
    ) -> None:
        check_name("look", look, LOOKS)
        check_name("target", target, TARGETS)
        check_name("kind", kind, KINDS)
        check_count("the size of a picture", size, _SMALLEST, _LARGEST)
        if env.robot is None:
            raise ValueError("the task has no scene that a camera could see")
        self.marker = target == "seen" and not env.shows_goal
        """Whether the target's marker is in the pictures."""
        self.model = _model_to_see(env.robot, self.marker, LOOKS[look].things)
        self.cameras, self.size, self.look, self.target, self.kind = tuple(cameras), size, look, target, kind
        ids = camera_ids(self.model, env.robot.scene, cameras)
        of_things = JOINTS if LOOKS[look].things else 0
        self.joints = self.model.nq - of_things
        """Joint positions that it is given."""
        self.draws = draws_of(self.model) + of_things
        """Numbers that a look takes."""
        self.renderer = resolve_renderer(renderer)
        """Name of the renderer."""
        self._made_of = env, self.cameras, size, self.renderer, look, target, kind
        self._render = RENDERERS[self.renderer](self.model, ids, size, LOOKS[look], kind == "depth")

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles and copies pictures by how they were made: a renderer belongs to its process."""
        return type(self), self._made_of

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of the pictures of a scene."""
        return len(self.cameras), self.size, self.size, KINDS[self.kind]

    def __call__(self, qpos: jax.Array, draws: jax.Array) -> jax.Array:
        draws, of_things = jnp.split(draws, [draws_of(self.model)], axis=-1)
        if of_things.shape[-1]:
            qpos = jnp.concatenate([qpos, places_of_things(of_things)], axis=-1)
        pictures = self._render(qpos.reshape(-1, qpos.shape[-1]), draws.reshape(-1, draws.shape[-1]))
        return pictures.reshape(*qpos.shape[:-1], *self.shape)


def _model_to_see(robot: Any, marker: bool, things: bool) -> mujoco.MjModel:
    """Compiles a robot's scene with all that is visible, and without contacts, which MJX may not know.

    The joints of a marker, and after them those of things, follow the scene's own.
    """
    spec = robot.spec()
    for pair in list(spec.pairs):
        spec.delete(pair)
    if marker:
        site = spec.site("target")
        add_sliding_body(spec, MARKER, type=site.type, size=site.size, rgba=site.rgba, group=VISUAL_GROUP)
    if things:
        add_things(spec, VISUAL_GROUP)
    with explained(robot.scene):
        return spec.compile()


def resolve_renderer(renderer: str) -> str:
    """Returns the name of the renderer that is asked for, on this machine; a ValueError if it cannot run here."""
    check_name("renderer", renderer, ["auto", *RENDERERS])
    engine = resolve_impl("auto")  # "c" on a CPU alone
    if renderer == "auto":
        if engine == "jax":
            raise ValueError("pictures on a GPU need warp-lang; install the extra warp, or set JAX_PLATFORMS=cpu")
        return "warp" if engine == "warp" else "opengl"
    if renderer == "warp" and importlib.util.find_spec("warp") is None:
        raise ValueError("the renderer 'warp' needs warp-lang, the extra warp; use 'opengl' or 'auto'")
    if renderer == "opengl" and engine != "c":
        raise ValueError("the renderer 'opengl' is for programs on a CPU; use 'auto', or set JAX_PLATFORMS=cpu")
    return renderer

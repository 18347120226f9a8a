"""Goals of `hgail_envs.fetch.tower.Tower`: a position, whose it is, and whether the cube is left there.

Below, a goal is `[..., 7]`, of the layout `GOAL`, and the features are `[..., 35]`, of the layout `FEATURES`.
"""

import jax
import jax.numpy as jnp
from flax import struct

from hgail_envs.fetch.cubes import is_in_place, is_left
from hgail_envs.fetch.layouts import GAP, GRIPPER, TARGET, of_object
from hgail_envs.layout import Layout, flag

TOP, MIDDLE, BASE = range(3)
"""Roles of the cubes, in the order of the features."""
ROLES = ("top", "middle", "base")
"""Their names."""
CUBES = len(ROLES)
"""Their number."""


def _features(cubes: tuple[str, ...]) -> Layout:
    first, second, third = map(of_object, cubes)
    return GRIPPER + first + second + third + Layout(GAP, flag("hand holds a cube"))


FEATURES = _features(tuple(f"{role} cube" for role in ROLES))
"""Layout of the features."""
SEEN = _features(("target's cube", "cube below it", "third cube"))
"""Layout of the features in an observation."""
GOAL = Layout(
    TARGET, *(flag(f"target is the {role} cube's") for role in ROLES), flag("the cube is to be left at the target")
)
"""Layout of a goal; the target of no cube is the gripper's."""

_RAISED = 0.45  # metres of height; on the table a cube's centre is at 0.425, on another cube at 0.475
_OF_ONE = of_object("cube")
_OF_CUBES = slice(GRIPPER.size, GRIPPER.size + CUBES * _OF_ONE.size)
_WHOSE = slice(TARGET.size, TARGET.size + CUBES)
_KIND_ON_TABLE, _KIND_OF_MIDDLE, _KIND_OF_TOP = 1, 3, 5  # one higher if the cube is left


class TowerPlan(struct.PyTreeNode):
    """The goals of an episode of `hgail_envs.fetch.tower.Tower`."""

    goal: jax.Array
    """`[goal_size]`: pursued where `elsewhere`."""
    elsewhere: jax.Array
    """`[]` boolean: whether the goal is `goal`."""
    relay: jax.Array
    """`[]` boolean: whether the goals are the stages on the way to a placement."""


def goal_of(position: jax.Array, role: jax.Array | int = CUBES, left: jax.Array | bool = False) -> jax.Array:
    """Returns the goal, `[7]`, of a position, `[3]`, of the cube of a role, or of the gripper without a role."""
    return jnp.concatenate([position, jnp.arange(CUBES) == role, jnp.asarray(left)[None]], dtype=jnp.float32)


def is_of_gripper(goal: jax.Array) -> jax.Array:
    """Returns whether goals are the gripper's: booleans `[...]`."""
    return (goal[..., _WHOSE] <= 0.5).all(axis=-1)


def is_to_be_left(goal: jax.Array) -> jax.Array:
    """Returns whether the cube of goals is to be left there: booleans `[...]`."""
    return goal[..., GOAL["the cube is to be left at the target"]] > 0.5


def goal_kind(goal: jax.Array) -> jax.Array:
    """Returns 0 for goals of the gripper, 1 of a cube on the table, 3 of the middle and 5 of the top above it.

    Those of a cube that is left are one higher. The base counts as on the table wherever it is.
    """
    is_base, is_top = (goal[..., _WHOSE][..., role] > 0.5 for role in (BASE, TOP))
    raised = (goal[..., 2] > _RAISED) & ~is_base
    of_cube = jnp.where(raised, jnp.where(is_top, _KIND_OF_TOP, _KIND_OF_MIDDLE), _KIND_ON_TABLE)
    return jnp.where(is_of_gripper(goal), 0, of_cube + is_to_be_left(goal))


def is_at(position: jax.Array, goal: jax.Array, threshold: float) -> jax.Array:
    """Returns whether positions, `[..., 3]`, are at goals: booleans `[...]`.

    That is within `threshold`, metres, or in the place of a cube that is to be left there.
    """
    apart = position - goal[..., :3]
    return jnp.where(is_to_be_left(goal), is_in_place(apart), jnp.linalg.norm(apart, axis=-1) <= threshold)


def position_of(features: jax.Array, goal: jax.Array) -> jax.Array:
    """Returns the position in `features` of the body that each goal refers to, `[..., 3]`."""
    gripper, cube = features[..., FEATURES["gripper position"]], _of_cube(features, goal)[..., _OF_ONE["cube position"]]
    return jnp.where(is_of_gripper(goal)[..., None], gripper, cube)


def is_left_as_wanted(features: jax.Array, goal: jax.Array) -> jax.Array:
    """Returns whether the cube of each goal is left, or not, as the goal wants it, `[...]`; True for the gripper's."""
    cube, gap = _of_cube(features, goal), features[..., FEATURES["gap between the fingers"]]
    apart, velocity = (cube[..., _OF_ONE[name]] for name in ("cube position less gripper position", "cube velocity"))
    return is_of_gripper(goal) | (is_left(apart, velocity, gap) == is_to_be_left(goal))


def pursued_first(features: jax.Array, goal: jax.Array) -> jax.Array:
    """Returns features with the cube of their goals first, then the one that it is to lie on, of the layout `SEEN`.

    So one placement looks like the other. The order is the roles', turned; goals of the gripper leave it as it is.
    """
    turned = (jnp.argmax(goal[..., _WHOSE], axis=-1)[..., None] + jnp.arange(CUBES)) % CUBES
    cubes = jnp.take_along_axis(_cubes(features), turned[..., None], axis=-2).reshape(*features.shape[:-1], -1)
    before, after = features[..., : _OF_CUBES.start], features[..., _OF_CUBES.stop :]
    return jnp.concatenate([before, cubes, after], axis=-1)


def _cubes(features: jax.Array) -> jax.Array:
    """Returns the numbers of each cube, by role, `[..., 3, 9]`."""
    return features[..., _OF_CUBES].reshape(*features.shape[:-1], CUBES, _OF_ONE.size)


def _of_cube(features: jax.Array, goal: jax.Array) -> jax.Array:
    """Returns the numbers, `[..., 9]`, of the cube that each goal refers to, or of any if it is the gripper's."""
    role = jnp.argmax(goal[..., _WHOSE], axis=-1)
    return jnp.take_along_axis(_cubes(features), role[..., None, None], axis=-2)[..., 0, :]

"""Goals of `hgail_envs.fetch.tower.Tower`: a position, whose it is, and whether the cube is left there.

Below, a goal is `[..., 7]` and the features, those of an observation of `Tower`, are `[..., 35]`.
"""

import jax
import jax.numpy as jnp
from flax import struct

from hgail_envs.fetch.cubes import is_in_place, is_left

TOP, MIDDLE, BASE = range(3)
"""Roles of the cubes, in the order of the observation."""
CUBES = 3
"""Their number."""

_RAISED = 0.45  # metres of height; on the table a cube's centre is at 0.425, on another cube at 0.475
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
    return (goal[..., 3:6] <= 0.5).all(axis=-1)


def goal_kind(goal: jax.Array) -> jax.Array:
    """Returns the kinds of goals, integers `[...]`; see `Tower.goal_kind`."""
    is_base, is_top = (goal[..., 3 + role] > 0.5 for role in (BASE, TOP))
    raised = (goal[..., 2] > _RAISED) & ~is_base
    of_cube = jnp.where(raised, jnp.where(is_top, _KIND_OF_TOP, _KIND_OF_MIDDLE), _KIND_ON_TABLE)
    return jnp.where(is_of_gripper(goal), 0, of_cube + (goal[..., 6] > 0.5))


def is_at(position: jax.Array, goal: jax.Array, threshold: float) -> jax.Array:
    """Returns whether positions, `[..., 3]`, are at goals: booleans `[...]`.

    That is within `threshold`, metres, or in the place of a cube that is to be left there.
    """
    apart = position - goal[..., :3]
    return jnp.where(goal[..., 6] > 0.5, is_in_place(apart), jnp.linalg.norm(apart, axis=-1) <= threshold)


def position_of(features: jax.Array, goal: jax.Array) -> jax.Array:
    """Returns the position, `[..., 3]`, in features of that whose goals are."""
    return jnp.where(is_of_gripper(goal)[..., None], features[..., :3], _of_cube(features, goal)[..., 3:6])


def is_left_as_wanted(features: jax.Array, goal: jax.Array) -> jax.Array:
    """Returns whether the cube is left, or not, as its goals want it: booleans `[...]`; the gripper's want nothing."""
    cube = _of_cube(features, goal)
    left = is_left(cube[..., :3], cube[..., 6:9], features[..., 33])
    return is_of_gripper(goal) | (left == (goal[..., 6] > 0.5))


def pursued_first(features: jax.Array, goal: jax.Array) -> jax.Array:
    """Returns features, `[..., 35]`, with the cube of their goals first, then the one that it is to lie on.

    So one placement looks like the other. The order is the roles', turned; goals of the gripper leave it as it is.
    """
    cubes = features[..., 6:33].reshape(*features.shape[:-1], CUBES, 9)
    turned = (jnp.argmax(goal[..., 3:6], axis=-1)[..., None] + jnp.arange(CUBES)) % CUBES
    cubes = jnp.take_along_axis(cubes, turned[..., None], axis=-2).reshape(*features.shape[:-1], -1)
    return jnp.concatenate([features[..., :6], cubes, features[..., 33:]], axis=-1)


def _of_cube(features: jax.Array, goal: jax.Array) -> jax.Array:
    """Returns the numbers, `[..., 9]`, in features of the cube whose goals are, of any if they are the gripper's."""
    cubes = features[..., 6:33].reshape(*features.shape[:-1], CUBES, 9)
    return jnp.take_along_axis(cubes, jnp.argmax(goal[..., 3:6], axis=-1)[..., None, None], axis=-2)[..., 0, :]

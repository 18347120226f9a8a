"""Rules of stack and tower: when a cube is in its place on another, and when the hand has let go of it.

A cube is left where it is if the gripper is at least 5 cm from its centre, the fingers are at least 8 cm apart and the
cube is no faster than 5 cm/s, for a falling cube is left nowhere. A goal of a cube that is left is reached within
2.5 cm in the plane and 1 cm in height, any other goal within 5 cm.

Half the training episodes are relays, whose goal depends on the state alone: the gripper at the cube while it is more
than 4 cm from it, then the cube 5 cm above its place until it is within 2 cm of it in the plane, then in its place, and
once it is there, left there. In an eighth the goal is the gripper or a cube at a random place, cubes on the table. The
rest have the evaluation's goals.
"""

import jax
import jax.numpy as jnp
import numpy as np

from hgail_envs.fetch.arm import CONTROL_PERIOD
from hgail_envs.fetch.pick_and_place import AT_CUBE

LEAST_WIDEST_GAP = 0.085
"""Widest distance between the fingers of the narrowest hand, metres: a little more than an open hand must have."""

_MOST_ASIDE, _MOST_HIGH = 0.025, 0.01  # metres of a cube from its place, in the plane and in height
_LEAST_AWAY = 0.05  # metres between the gripper and a cube that it has let go of
_LEAST_GAP = 0.08  # metres between the fingers of an open hand
_AT_REST = 0.05  # metres per second, of a cube that lies where it was left
_OVER = 0.02  # metres in the plane from its place, within which a relay lowers a cube
_ABOVE = 0.05  # metres above its place, to which a relay first brings a cube


def is_left(apart: jax.Array, velocity: jax.Array, gap: jax.Array) -> jax.Array:
    """Returns whether a cube rests where the hand has let go of it: booleans `[...]`.

    `apart`, `[..., 3]`, is the cube's position less the gripper's, metres; its `velocity`, `[..., 3]`, is in metres per
    action and the `gap` between the fingers, `[...]`, in metres.
    """
    away = (jnp.linalg.norm(apart, axis=-1) >= _LEAST_AWAY) & (gap >= _LEAST_GAP)
    return away & (jnp.linalg.norm(velocity, axis=-1) <= _AT_REST * CONTROL_PERIOD)


def place_tolerance(goal: jax.Array) -> jax.Array:
    """Returns half the edges of a box that `is_in_place` accepts, `[goal_size]`, for goals `[..., goal_size]`."""
    aside = _MOST_ASIDE / np.sqrt(2.0)
    return jnp.zeros(goal.shape[-1]).at[:3].set(jnp.array([aside, aside, _MOST_HIGH]))


def is_in_place(apart: jax.Array) -> jax.Array:
    """Returns whether a cube `apart`, `[..., 3]`, from its place on another one is on it: booleans `[...]`."""
    return (jnp.linalg.norm(apart[..., :2], axis=-1) <= _MOST_ASIDE) & (jnp.abs(apart[..., 2]) <= _MOST_HIGH)


def relay(gripper: jax.Array, cube: jax.Array, place: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the stage of a relay until a cube is in its place; all positions are `[3]`, metres.

    The first result is a boolean: whether the gripper is yet to come to the cube. The second is the cube's goal:
    first above the place, then the place.
    """
    over = jnp.linalg.norm((cube - place)[:2]) <= _OVER
    return jnp.linalg.norm(gripper - cube) > AT_CUBE, jnp.where(over, place, place.at[2].add(_ABOVE))

"""What stack and tower have in common: when a cube is in its place on another, and when the hand has let go of it."""

import jax
import jax.numpy as jnp
import numpy as np

from hgail_envs.fetch.arm import CONTROL_PERIOD

MOST_ASIDE = 0.025
"""Largest distance in the plane of a cube from its place on another, metres."""
MOST_HIGH = 0.01
"""Largest difference in height of a cube from its place on another, metres."""
LEAST_AWAY = 0.05
"""Least distance between the gripper and a cube that it has let go of, metres."""
LEAST_GAP = 0.08
"""Least distance between the fingers of an open hand, metres."""
LEAST_WIDEST_GAP = 0.085
"""Widest distance between the fingers of the narrowest hand, metres: a little more than an open hand must have."""
AT_REST = 0.05
"""Largest speed of a cube that lies where it was left, metres per second."""
MOVED = 0.01
"""Distance of a cube from its start, beyond which its position may be the achieved goal, metres."""
AT_GOAL = 0.03
"""Distance between cube and goal, within which the goal is already solved, metres."""
RELAYS = 0.5
"""Fraction of the training episodes whose goals are relays: the hand to the cube, then the cube to its place."""
ELSEWHERE = 0.125
"""Fraction of the training episodes with a goal away from the place on the other cube."""

_AT_CUBE = 0.04  # metres between gripper and cube, within which a relay's goal becomes the cube's
_OVER = 0.02  # metres in the plane from its place, within which a relay lowers a cube
_ABOVE = 0.05  # metres above its place, to which a relay first brings a cube


def is_left(apart: jax.Array, velocity: jax.Array, gap: jax.Array) -> jax.Array:
    """Returns whether a cube rests where the hand has let go of it: booleans `[...]`.

    Args:
      apart: `[..., 3]`: the cube's position less the gripper's, metres.
      velocity: `[..., 3]`: the cube's, metres per action.
      gap: `[...]`: between the fingers, metres.

    """
    away = (jnp.linalg.norm(apart, axis=-1) >= LEAST_AWAY) & (gap >= LEAST_GAP)
    return away & (jnp.linalg.norm(velocity, axis=-1) <= AT_REST * CONTROL_PERIOD)


def place_tolerance(goal: jax.Array) -> jax.Array:
    """Returns half the edges of a box that `is_in_place` accepts, `[goal_size]`, for goals `[..., goal_size]`."""
    aside = MOST_ASIDE / np.sqrt(2.0)
    return jnp.zeros(goal.shape[-1]).at[:3].set(jnp.array([aside, aside, MOST_HIGH]))


def is_in_place(apart: jax.Array) -> jax.Array:
    """Returns whether a cube `apart`, `[..., 3]`, from its place on another one is on it: booleans `[...]`."""
    return (jnp.linalg.norm(apart[..., :2], axis=-1) <= MOST_ASIDE) & (jnp.abs(apart[..., 2]) <= MOST_HIGH)


def relay(gripper: jax.Array, cube: jax.Array, place: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns what a relay asks for until a cube is in its place: whether the gripper is to come, and the cube's goal.

    Args:
      gripper: `[3]`: its position, metres.
      cube: `[3]`.
      place: `[3]`: of the cube's centre on another cube.

    Returns:
      A boolean, that the gripper is yet to come to the cube, and `[3]`: first above the place, then the place.

    """
    over = jnp.linalg.norm((cube - place)[:2]) <= _OVER
    return jnp.linalg.norm(gripper - cube) > _AT_CUBE, jnp.where(over, place, place.at[2].add(_ABOVE))

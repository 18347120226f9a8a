"""What stack and tower have in common: when a cube is in its place on another, and when the hand has let go of it."""

import jax
import jax.numpy as jnp

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


def is_left(apart: jax.Array, velocity: jax.Array, gap: jax.Array) -> jax.Array:
    """Returns whether a cube rests where the hand has let go of it: booleans `[...]`.

    Args:
      apart: `[..., 3]`: the cube's position less the gripper's, metres.
      velocity: `[..., 3]`: the cube's, metres per action.
      gap: `[...]`: between the fingers, metres.

    """
    away = (jnp.linalg.norm(apart, axis=-1) >= LEAST_AWAY) & (gap >= LEAST_GAP)
    return away & (jnp.linalg.norm(velocity, axis=-1) <= AT_REST * CONTROL_PERIOD)


def is_in_place(apart: jax.Array) -> jax.Array:
    """Returns whether a cube `apart`, `[..., 3]`, from its place on another one is on it: booleans `[...]`."""
    return (jnp.linalg.norm(apart[..., :2], axis=-1) <= MOST_ASIDE) & (jnp.abs(apart[..., 2]) <= MOST_HIGH)

"""Scripted controllers of the Fetch tasks: they demonstrate a task, and show that its scene can be solved.

See `envs.base.Controller`. Those of grasp read the observation of `envs.fetch.grasp.Grasp`.
"""

import jax
import jax.numpy as jnp

_GAIN = 20.0  # actions per metre: full speed down to 5 cm
_DESCENT_GAIN = 4.0  # the hand comes in from above where z lags behind
_NEAR = 0.015  # metres between gripper and cube, within which the hand closes
_STRIDE = 0.033  # metres that the gripper moves with a unit action
_OPEN, _CLOSE = 1.0, -1.0


def reach(observation: jax.Array) -> jax.Array:
    """Moves the gripper straight to its goal (`envs.fetch.reach.Reach`), the hand's number at 0."""
    action = jnp.clip(_GAIN * (observation[..., 6:9] - observation[..., :3]), -1.0, 1.0)
    return _with_hand(action, jnp.zeros(action.shape[:-1]))


def grasp(observation: jax.Array) -> jax.Array:
    """Comes to the cube from above with an open hand, and closes it there; grasps every cube of the scene."""
    ahead = _ahead(observation)
    gain = jnp.array([_GAIN, _GAIN, _DESCENT_GAIN])
    return _with_hand(jnp.clip(gain * ahead, -1.0, 1.0), _close_when_near(ahead))


def straight(observation: jax.Array) -> jax.Array:
    """Goes to the cube in a straight line at full speed, open until near: knocks some of the cubes away."""
    ahead = _ahead(observation)
    return _with_hand(_line(ahead), _close_when_near(ahead))


def closed(observation: jax.Array) -> jax.Array:
    """Goes to the cube in a straight line with a closed hand, which can grasp nothing."""
    ahead = _ahead(observation)
    return _with_hand(_line(ahead), jnp.full(ahead.shape[:-1], _CLOSE))


def _ahead(observation: jax.Array) -> jax.Array:
    return observation[..., 8:11] - observation[..., :3]


def _line(ahead: jax.Array) -> jax.Array:
    farthest = jnp.max(jnp.abs(ahead), axis=-1, keepdims=True)
    return jnp.clip(ahead / jnp.maximum(farthest, _STRIDE), -1.0, 1.0)


def _close_when_near(ahead: jax.Array) -> jax.Array:
    return jnp.where(jnp.linalg.norm(ahead, axis=-1) <= _NEAR, _CLOSE, _OPEN)


def _with_hand(displacement: jax.Array, hand: jax.Array) -> jax.Array:
    return jnp.concatenate([displacement, hand[..., None]], axis=-1)

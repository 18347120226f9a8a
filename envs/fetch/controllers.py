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
_PUSHING_HEIGHT, _PASSING_HEIGHT = (
    0.42,
    0.5,
)  # metres of the gripper; the cube's top is at 0.45, the pads end 2 cm lower
_RUN_UP = 0.06  # metres behind the cube's centre at which a push begins
_BESIDE, _LINED_UP = 0.035, 0.015  # metres: the hand is behind the cube where it is as far back and as little aside
_LINE_GAIN = 20.0  # actions per metre, against going aside
_THERE = 0.01  # metres from the target at which a push is over


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


def pick_and_place(observation: jax.Array) -> jax.Array:
    """Grasps the cube as `grasp` does, and then moves the hand so that the cube comes to the target."""
    apart, remaining = observation[..., 6:9], observation[..., 17:20] - observation[..., 9:12]
    held = jnp.linalg.norm(apart, axis=-1) <= _NEAR
    approach = jnp.clip(jnp.array([_GAIN, _GAIN, _DESCENT_GAIN]) * apart, -1.0, 1.0)
    carry = jnp.where(observation[..., 16:17] > 0.5, jnp.clip(_GAIN * remaining, -1.0, 1.0), approach)
    return _with_hand(jnp.where(held[..., None], carry, approach), jnp.where(held, _CLOSE, _OPEN))


def push(observation: jax.Array) -> jax.Array:
    """Goes over the cube to the side away from the target, comes down there, and pushes it in a straight line."""
    gripper, apart, cube, target = (observation[..., i : i + 3] for i in (0, 6, 9, 15))
    remaining = (target - cube)[..., :2]
    distance = jnp.linalg.norm(remaining, axis=-1, keepdims=True)
    direction = remaining / jnp.maximum(distance, 1e-6)
    along = jnp.sum(-apart[..., :2] * direction, axis=-1, keepdims=True)  # of the hand, ahead of the cube's centre
    aside = -apart[..., :2] - along * direction
    behind = (along < -_BESIDE) & (jnp.linalg.norm(aside, axis=-1, keepdims=True) < _LINED_UP)
    low, high = gripper[..., 2:] < _PUSHING_HEIGHT + 0.01, gripper[..., 2:] > _PASSING_HEIGHT - 0.02
    to_start = apart[..., :2] - _RUN_UP * direction
    pushing = _LINE_GAIN * -aside + jnp.minimum(_GAIN * distance, 1.0) * direction * (distance > _THERE)
    across = jnp.where(behind & low, pushing, jnp.where(high | behind, _GAIN * to_start, 0.0))
    height = jnp.where(behind | (distance <= _THERE), _PUSHING_HEIGHT, _PASSING_HEIGHT)
    across = jnp.where((distance <= _THERE) & ~high, 0.0, across)
    move = jnp.concatenate([across, _GAIN * (height - gripper[..., 2:])], axis=-1)
    return _with_hand(jnp.clip(move, -1.0, 1.0), jnp.zeros(move.shape[:-1]))


def _ahead(observation: jax.Array) -> jax.Array:
    return observation[..., 8:11] - observation[..., :3]


def _line(ahead: jax.Array) -> jax.Array:
    farthest = jnp.max(jnp.abs(ahead), axis=-1, keepdims=True)
    return jnp.clip(ahead / jnp.maximum(farthest, _STRIDE), -1.0, 1.0)


def _close_when_near(ahead: jax.Array) -> jax.Array:
    return jnp.where(jnp.linalg.norm(ahead, axis=-1) <= _NEAR, _CLOSE, _OPEN)


def _with_hand(displacement: jax.Array, hand: jax.Array) -> jax.Array:
    return jnp.concatenate([displacement, hand[..., None]], axis=-1)

"""Scripted controllers of the Fetch tasks: they demonstrate a task, and show that its scene can be solved.

Each maps the values of an observation by name, those of its task's layouts, to an action, `[..., 4]`. A task makes a
`hgail_envs.base.Controller` of it by `Layout.readers`.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp

Seen = Mapping[str, jax.Array]
"""Values of an observation by name, `[..., quantity.size]`, or `[...]` of a single number."""

_GAIN = 20.0  # actions per metre: full speed down to 5 cm
_DESCENT_GAIN = 4.0  # lower than in the plane, so that the hand is above the cube before it is low
_NEAR = 0.015  # metres between gripper and cube, within which the hand closes
_SLIPPED = 0.03  # metres between gripper and a cube that slips in a closed hand
_WIDTH, _LOOSE = 0.05, 0.012  # metres of a cube, and by which the gap of fingers around it differs
_STRIDE = 0.033  # metres that the gripper moves with a unit action
_OPEN, _CLOSE = 1.0, -1.0
_GRAVITY = 9.81  # m/s²
_PERIOD = 0.04  # seconds between two actions
_FULL_SPEED = _STRIDE / _PERIOD  # m/s
_SAFE_SPEED = 0.6  # actions; a cube that is pushed faster tips over
_PUSHING_HEIGHT, _PASSING_HEIGHT = 0.42, 0.5  # metres of the gripper; a cube's top is at 0.45, the pads end 2 cm lower
_BELOW_TOP = 0.45  # metres of the gripper, whose pads touch the cube there
_COMING_DOWN = 0.001  # metres an action, from which a hand is on its way down
_CLEAR = 0.475  # least height of the gripper at which the hand passes over an object, metres
_RUN_UP = 0.06  # metres behind the object's centre at which a push begins
_BESIDE, _LINED_UP = 0.028, 0.015  # metres: a hand behind the object is at least as far back and at most as far aside
_THERE = 0.01  # metres from the target at which a push is over
_PUCK_FRICTION = 0.1
_ENOUGH = 0.9  # fraction of the speed that brings a free puck to the target, below which the hand takes it again
_CENTRED = 0.02  # metres between hand and puck in the plane, within which the hand presses
_CARRYING = 0.1  # metres of a carried cube's centre above that of the cube that it is to lie on
_STACKED = 0.008  # metres between their centres in the plane, within which it is lowered
_LYING, _PRESSING_DOWN = 0.0515, 0.045  # metres above that centre, at which it lies there; and to which it is lowered
_WIDE = 0.072  # metres between the fingers, from which the hand withdraws
_CLEAR_OF_TOWER = 0.1  # metres above the cube's centre, to which it withdraws
_PASSING_TOWER = 0.56  # metres of the gripper, over a tower of two, whose top is at 0.5
_PRESSED, _PRESSING = 0.452, 0.462  # metres of the gripper, whose pads touch the puck's top at 0.4575


def reach(seen: Seen) -> jax.Array:
    """Moves the gripper straight to its goal, with a gripper command of 0."""
    action = jnp.clip(_GAIN * _ahead(seen), -1.0, 1.0)
    return _with_hand(action, jnp.zeros(action.shape[:-1]))


def grasp(seen: Seen) -> jax.Array:
    """Comes to the cube from above with an open hand, and closes it there; grasps every cube of the scene."""
    ahead = _ahead(seen)
    gain = jnp.array([_GAIN, _GAIN, _DESCENT_GAIN])
    return _with_hand(jnp.clip(gain * ahead, -1.0, 1.0), _close_when_near(ahead))


def straight(seen: Seen) -> jax.Array:
    """Goes to the cube in a straight line at full speed, open until near: knocks some of the cubes away."""
    ahead = _ahead(seen)
    return _with_hand(_line(ahead), _close_when_near(ahead))


def closed(seen: Seen) -> jax.Array:
    """Goes to the cube in a straight line with a closed hand, which can grasp nothing."""
    ahead = _ahead(seen)
    return _with_hand(_line(ahead), jnp.full(ahead.shape[:-1], _CLOSE))


def pick_and_place(seen: Seen) -> jax.Array:
    """Grasps the cube as `grasp` does, and then moves the hand so that the cube comes to the target."""
    apart, remaining = seen["cube position less gripper position"], seen["target position"] - seen["cube position"]
    held = seen["hand holds the cube"] > 0.5
    close = held | _keep_closed(apart, seen["gap between the fingers"])
    approach = jnp.array([_GAIN, _GAIN, _DESCENT_GAIN]) * apart
    move = jnp.where(held[..., None], _GAIN * remaining, approach)
    return _with_hand(jnp.clip(move, -1.0, 1.0), jnp.where(close, _CLOSE, _OPEN))


def stack(seen: Seen) -> jax.Array:
    """Grasps cube A from above, carries it over cube B, lowers it, lets go of it and rises."""
    return _put_on(seen, "cube A", "cube B", "hand holds cube A", _PASSING_HEIGHT, 0.0)


def tower(seen: Seen) -> jax.Array:
    """Does as `stack` does with the cube that the goal names and the one that it is to lie on; passes above both."""
    return _put_on(seen, "target's cube", "cube below it", "hand holds a cube", _PASSING_TOWER, _PASSING_TOWER - 0.01)


def _put_on(seen: Seen, cube: str, below: str, holding: str, passing: float, clear: float) -> jax.Array:
    """Puts a cube on the one `below`, both by name; `holding` is the name of the flag that the hand holds the cube.

    On its way to the cube the hand rises to the height `passing`, and above `clear` it moves in the plane, metres.
    """
    height, gap = seen["gripper position"][..., 2:], seen["gap between the fingers"][..., None]
    apart, way = seen[f"{cube} position less gripper position"], seen[f"{below} position"] - seen[f"{cube} position"]
    aside, above = jnp.linalg.norm(way[..., :2], axis=-1, keepdims=True), -way[..., 2:]
    held = seen[holding][..., None] > 0.5
    close = held | _keep_closed(apart, gap[..., 0])[..., None]
    lies = (aside <= _CENTRED) & (above > 0.0) & (above <= _LYING)

    over = jnp.linalg.norm(apart[..., :2], axis=-1, keepdims=True) <= _CENTRED
    down = jnp.where(over, _GAIN * apart[..., 2:], _GAIN * jnp.maximum(passing - height, 0.0))
    comes = jnp.where(over | (height >= clear), _GAIN * apart[..., :2], 0.0)
    approach = jnp.concatenate([comes, down], axis=-1)

    centred = aside <= _STACKED
    across = jnp.where((above >= _CARRYING - 0.01) | centred, _GAIN * way[..., :2], 0.0)
    lower = jnp.maximum(_DESCENT_GAIN * (_PRESSING_DOWN - above), -0.5)
    carry = jnp.concatenate([across, jnp.where(centred, lower, _GAIN * (_CARRYING - above))], axis=-1)

    opened = gap >= _WIDE
    up = jnp.where(opened & (apart[..., 2:] > -_CLEAR_OF_TOWER), 1.0, 0.0)
    retreat = jnp.concatenate([jnp.zeros_like(way[..., :2]), up], axis=-1)

    move = jnp.where(lies, retreat, jnp.where(held, carry, approach))
    hand = jnp.where(close & ~lies, _CLOSE, _OPEN)
    return _with_hand(jnp.clip(move, -1.0, 1.0), hand[..., 0])


def push(seen: Seen) -> jax.Array:
    """Goes over the cube to the side away from the target, comes down there, and pushes it in a straight line."""
    height, apart = seen["gripper position"][..., 2:], seen["cube position less gripper position"][..., :2]
    distance, direction = _way(seen, "cube")
    ahead = -jnp.sum(apart * direction, axis=-1, keepdims=True)  # of the cube's centre, the hand
    aside = -apart - ahead * direction
    over = distance <= _THERE
    behind = (ahead < -_BESIDE) & (jnp.linalg.norm(aside, axis=-1, keepdims=True) < _LINED_UP) & ~over
    # v² = 2 µ g d, with µ = 1: the cube slides no farther than the target once the hand stops.
    speed = jnp.minimum(jnp.sqrt(2.0 * _GRAVITY * distance) / _FULL_SPEED, _SAFE_SPEED)
    pushes = speed * direction - _GAIN * aside
    goes_round = jnp.where(height > _CLEAR, _GAIN * (apart - _RUN_UP * direction), 0.0)
    falls = seen["gripper velocity"][..., 2:] <= -_COMING_DOWN
    stays = (height < _BELOW_TOP) & ~falls  # where a larger clearance keeps some hands
    low = (height < _PUSHING_HEIGHT + 0.01) | stays
    across = jnp.where(behind, jnp.where(low, pushes, goes_round), jnp.where(over, 0.0, goes_round))
    wanted = jnp.where(behind, _PUSHING_HEIGHT, _PASSING_HEIGHT)
    return _closed(across, _GAIN * (wanted - height))


def slide(seen: Seen) -> jax.Array:
    """Presses on the puck from above, drags it, and lets go once it is fast enough to slide to the target.

    A dragged puck leaves the hand at 0.6 m/s at most and then slides 0.2 m: it cannot reach the farther half of the
    targets.
    """
    height, apart = seen["gripper position"][..., 2:], seen["puck position less gripper position"][..., :2]
    distance, _ = _way(seen, "puck")
    wanted = _launch((seen["target position"] - seen["puck position"])[..., :2])
    drags = wanted / jnp.maximum(jnp.max(jnp.abs(wanted), axis=-1, keepdims=True), _FULL_SPEED)
    above = jnp.linalg.norm(apart, axis=-1, keepdims=True) <= _CENTRED
    dragging = above & (height < _PRESSING)
    hand = seen["gripper velocity"][..., :2]
    moving = jnp.where(dragging, hand, seen["puck velocity"][..., :2] / _ENOUGH) / _PERIOD
    launched = jnp.sum(moving * wanted, axis=-1, keepdims=True) >= jnp.sum(wanted**2, axis=-1, keepdims=True)
    launched = launched | (distance <= _THERE)
    comes = jnp.where(above | (height > _CLEAR), _GAIN * apart, 0.0)
    across = jnp.where(dragging | (above & launched), drags, comes)
    return _closed(across, _GAIN * (jnp.where(above & ~launched, _PRESSED, _PASSING_HEIGHT) - height))


def _launch(remaining: jax.Array) -> jax.Array:
    """Returns the velocity, `[..., 2]` in m/s, from which a puck slides by `remaining`, `[..., 2]` metres.

    MuJoCo's default friction cone, which not all hands have, is a pyramid whose edges lie along x and y. So the puck is
    slowed along x + y and along x - y by the same deceleration each, independently of the other: v² = 2 µ g d along
    each diagonal.
    """
    x, y = remaining[..., 0], remaining[..., 1]
    diagonals = jnp.stack([x + y, x - y], axis=-1)
    speeds = jnp.sign(diagonals) * jnp.sqrt(2.0 * _PUCK_FRICTION * _GRAVITY * jnp.abs(diagonals))
    return jnp.stack([speeds[..., 0] + speeds[..., 1], speeds[..., 0] - speeds[..., 1]], axis=-1) / 2.0


def _way(seen: Seen, thing: str) -> tuple[jax.Array, jax.Array]:
    """Returns the distance, `[..., 1]`, and direction, `[..., 2]`, from an object to the target in the plane."""
    remaining = (seen["target position"] - seen[f"{thing} position"])[..., :2]
    distance = jnp.linalg.norm(remaining, axis=-1, keepdims=True)
    return distance, remaining / jnp.maximum(distance, 1e-6)  # no division by 0 at the target


def _closed(across: jax.Array, up: jax.Array) -> jax.Array:
    """Returns actions from displacements in the plane, `[..., 2]`, and along z, `[..., 1]`, for blocked fingers."""
    move = jnp.clip(jnp.concatenate([across, up], axis=-1), -1.0, 1.0)
    return _with_hand(move, jnp.zeros(move.shape[:-1]))


def _ahead(seen: Seen) -> jax.Array:
    return seen["target position"] - seen["gripper position"]


def _line(ahead: jax.Array) -> jax.Array:
    # The largest component is at full speed and the others in proportion: clipping each alone would bend the way.
    farthest = jnp.max(jnp.abs(ahead), axis=-1, keepdims=True)
    return jnp.clip(ahead / jnp.maximum(farthest, _STRIDE), -1.0, 1.0)


def _keep_closed(apart: jax.Array, gap: jax.Array) -> jax.Array:
    """Returns whether the hand is to close: near the cube, or farther with the cube between its fingers, `[...]`."""
    distance = jnp.linalg.norm(apart, axis=-1)
    return (distance <= _NEAR) | ((distance <= _SLIPPED) & (jnp.abs(gap - _WIDTH) <= _LOOSE))


def _close_when_near(ahead: jax.Array) -> jax.Array:
    return jnp.where(jnp.linalg.norm(ahead, axis=-1) <= _NEAR, _CLOSE, _OPEN)


def _with_hand(displacement: jax.Array, hand: jax.Array) -> jax.Array:
    return jnp.concatenate([displacement, hand[..., None]], axis=-1)

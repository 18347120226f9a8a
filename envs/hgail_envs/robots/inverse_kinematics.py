"""Inverse kinematics: a step of joints towards a place of a tool, by damped least squares."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

TURN_WEIGHT = 0.15
"""Metres that count as much as a radian."""

_DAMPING = 1e-4  # m²
_TO_HOME = 0.05  # fraction of the way to the home posture, where the tool leaves a choice


def damped_step(
    way: Any, turn: Any, jacobian: Any, home: Any, limits: Any, xp: Any = jnp, tilt_weight: float = TURN_WEIGHT
) -> Any:
    """Returns the step of joints, `[joints]`, that moves a tool by damped least squares.

    Args:
      way: `[3]`, metres that the tool is to move.
      turn: `[3]`, rotation vector that it is to turn by, radians.
      jacobian: `[6, joints]`, of the tool's velocity and then of its angular velocity.
      home: `[joints]`, step to the posture to which more than six joints tend, whose places the tool leaves open.
      limits: `[2, joints]`, least and most step by the limits of the joints.
      xp: the array module.
      tilt_weight: metres that count as much as a radian around the first two axes; `TURN_WEIGHT` is that of the third.

    """
    weights = np.array([1.0, 1.0, 1.0, tilt_weight, tilt_weight, TURN_WEIGHT])
    error, rows = weights * xp.concatenate([way, turn]), weights[:, None] * jacobian

    to_home = _TO_HOME if len(home) > len(error) else 0.0  # without a choice it would be an error

    def attempt(_: int, state: tuple[Any, Any]) -> tuple[Any, Any]:
        free, step = state  # joints that move, and the step that the others make
        movable, bias = rows * free, to_home * home * free
        remaining = error - (rows * xp.where(free, bias, step)).sum(axis=1)
        # Sums of products, which XLA fuses: there products and LAPACK take a hundred times as long for matrices of this
        # size. In NumPy it is LAPACK that is faster.
        normal = (movable[:, None] * movable).sum(axis=2) + _DAMPING * np.eye(6)
        multipliers = _solve(normal, remaining) if xp is jnp else np.linalg.solve(normal, remaining)
        solved = bias + (movable * multipliers[:, None]).sum(axis=0)
        wanted = xp.where(free, solved, step)
        limited = xp.clip(wanted, *limits)
        return free & (limited == wanted), limited

    # To clip once would diverge: the other joints have to do what one at its limit does not. A loop of the program, for
    # else XLA computes the kinematics anew for each number of the matrix.
    loop = jax.lax.fori_loop if xp is jnp else _loop
    return loop(0, 2, attempt, (xp.ones(home.shape, bool), xp.zeros_like(home)))[1]


def _loop(first: int, last: int, body: Any, state: Any) -> Any:
    for index in range(first, last):
        state = body(index, state)
        if state[0].all():  # no joint came to its limit, so another attempt would step alike
            break
    return state


def _solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solves a small system, `[n, n]` and `[n]`, whose matrix is symmetric and positive, by Cholesky's method."""
    size = len(right)
    lower: list[list[Any]] = []
    solution: list[Any] = []
    for i in range(size):
        row: list[Any] = []
        for j in range(i):
            row.append((matrix[i, j] - sum(row[k] * lower[j][k] for k in range(j))) / lower[j][j])
        row.append(jnp.sqrt(matrix[i, i] - sum(value**2 for value in row)))
        lower.append(row)
        solution.append((right[i] - sum(row[k] * solution[k] for k in range(i))) / row[i])
    for i in reversed(range(size)):
        solution[i] = (solution[i] - sum(lower[k][i] * solution[k] for k in range(i + 1, size))) / lower[i][i]
    return jnp.stack(solution)

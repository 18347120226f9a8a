"""Follows a robot's arm from its base to its hand, in closed form.

MJX's kinematics visit all bodies, level by level, in hundreds of small operations. Here all is arithmetic on single
numbers, which XLA fuses into a few.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

_Numbers = tuple  # of scalars, each a number or an array `[]`: 3 of a vector, 4 of a quaternion


class Pose(NamedTuple):
    """Where the end of a chain is, in the world's frame."""

    site_position: jax.Array
    """`[3]`, metres."""
    site_velocity: jax.Array
    """`[3]`, metres per second."""
    body_position: jax.Array
    """`[3]`: of the body that carries the site."""
    body_quaternion: jax.Array
    """`[4]`: its orientation."""


class Chain:
    """The bodies from the world to the one that carries a site, joined by hinges and slides alone.

    Args:
      model: the model.
      site: the site's name.

    Raises:
      ValueError: the chain has a joint of another kind.

    """

    def __init__(self, model: mujoco.MjModel, site: str):
        self._model = model
        self._site = model.site(site).id
        body = int(model.site_bodyid[self._site])
        self._bodies = [body]
        while body := int(model.body_parentid[body]):
            self._bodies.insert(0, body)
        self._joints = np.flatnonzero(np.isin(model.jnt_bodyid, self._bodies))
        kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        if not np.isin(model.jnt_type[self._joints], kinds).all():
            raise ValueError(f"the chain to the site {site!r} has a joint that is neither a hinge nor a slide")

    def pose(self, qpos: jax.Array, qvel: jax.Array) -> Pose:
        """Returns where positions `[nq]` and velocities `[nv]` of the joints bring the end of the chain."""
        moving = qvel[self._model.jnt_dofadr[self._joints]]
        rates = jnp.zeros_like(qpos).at[self._model.jnt_qposadr[self._joints]].set(moving)
        (site, body, quaternion), (velocity, _, _) = jax.jvp(self._follow, (qpos,), (rates,))
        return Pose(site, velocity, body, quaternion)

    def _follow(self, qpos: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        model = self._model
        position: _Numbers = (0.0, 0.0, 0.0)
        quaternion: _Numbers = (1.0, 0.0, 0.0, 0.0)
        for body in self._bodies:
            position = _add(position, _rotate(quaternion, model.body_pos[body]))
            quaternion = _multiply(quaternion, _numbers(model.body_quat[body]))
            first = int(model.body_jntadr[body])
            for joint in range(first, first + int(model.body_jntnum[body])):
                address = int(model.jnt_qposadr[joint])
                value, axis = qpos[address] - float(model.qpos0[address]), _numbers(model.jnt_axis[joint])
                if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
                    position = _add(position, _rotate(quaternion, axis, value))
                    continue
                anchor = _add(position, _rotate(quaternion, model.jnt_pos[joint]))
                half = jnp.sin(0.5 * value)
                turn = (jnp.cos(0.5 * value), *(half * component for component in axis))
                quaternion = _multiply(quaternion, turn)
                position = _add(anchor, _rotate(quaternion, model.jnt_pos[joint], -1.0))
        site = _add(position, _rotate(quaternion, model.site_pos[self._site]))
        return jnp.stack(site), jnp.stack(position), jnp.stack(quaternion)


def _numbers(array: np.ndarray) -> _Numbers:
    return tuple(float(value) for value in array)


def _add(one: _Numbers, other: _Numbers) -> _Numbers:
    return tuple(a + b for a, b in zip(one, other, strict=True))


def _multiply(one: _Numbers, other: _Numbers) -> _Numbers:
    """Hamilton's product of two quaternions."""
    a, b, c, d = one
    e, f, g, h = other
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def _rotate(quaternion: _Numbers, vector: np.ndarray | _Numbers, scale: jax.Array | float = 1.0) -> _Numbers:
    """Returns a constant vector, times `scale`, turned by a quaternion."""
    if not np.any(vector):
        return (0.0, 0.0, 0.0)
    inverse = (quaternion[0], *(-component for component in quaternion[1:]))
    turned = _multiply(_multiply(quaternion, (0.0, *(scale * float(value) for value in vector))), inverse)
    return turned[1:]

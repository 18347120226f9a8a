"""Forward kinematics of a robot's arm from its base to its hand, in closed form.

MJX's kinematics visit all bodies, level by level, in hundreds of small operations. This is arithmetic on single
numbers, which XLA fuses into a few operations, and constant zeros drop out. The same chain on `brax.math` is 4,295
equations instead of 735, compiles in 4 to 6 s instead of 0.7 s and takes seven times as long (1,024 arms, 2 CPU cores).
"""

import functools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

_Number = Any  # a float, which is a constant, or an array `[]`
_Numbers = Sequence[_Number]  # 3 of a vector, 4 of a quaternion


class Pose(NamedTuple):
    """Pose and velocity of the end of a chain, in the world's frame."""

    site_position: jax.Array
    """`[3]`, metres."""
    site_velocity: jax.Array
    """`[3]`, metres per second."""
    body_position: jax.Array
    """`[3]`: position of the body that carries the site, metres."""
    body_quaternion: jax.Array
    """`[4]`: orientation of that body."""


class Chain:
    """The bodies to the one that carries the site of a name, joined by hinges and slides alone.

    Where no site has that name, it is the place of a geom. The bodies begin at the world, or at the one named `base`,
    in whose frame poses then are.
    """

    def __init__(self, model: mujoco.MjModel, site: str, base: str = "world") -> None:
        self._model = model
        is_site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, site) >= 0
        end = model.site(site) if is_site else model.geom(site)
        self._offset = _numbers(end.pos)
        body, first = int(end.bodyid[0]), model.body(base).id
        self._bodies: list[int] = []
        while body != first:
            self._bodies.insert(0, body)
            body = int(model.body_parentid[body])
        self._joints = np.flatnonzero(np.isin(model.jnt_bodyid, self._bodies))
        kinds = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
        if not np.isin(model.jnt_type[self._joints], kinds).all():
            raise ValueError(f"the chain to the site {site!r} has a joint that is neither a hinge nor a slide")

    def pose(self, qpos: jax.Array, qvel: jax.Array) -> Pose:
        """Returns the pose of the chain's end for joint positions `[nq]` and velocities `[nv]`."""
        moving = qvel[self._model.jnt_dofadr[self._joints]]
        rates = jnp.zeros_like(qpos).at[self._model.jnt_qposadr[self._joints]].set(moving)
        # The site's velocity is the Jacobian times the joints' velocities: one forward-mode derivative.
        (site, body, quaternion), (velocity, _, _) = jax.jvp(self.follow, (qpos,), (rates,))
        return Pose(site, velocity, body, quaternion)

    def jacobian(self, qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the body's quaternion, `[4]`, and the derivatives by each joint of the chain, `[6, joints]`.

        The first three rows are of the site's position, in metres, the others of the rotation, in radians.
        """
        joints: list[tuple[_Numbers, _Numbers, _Numbers]] = []
        site, _, quaternion = self.follow(qpos, joints)
        columns = []
        for before, axis, anchor in joints:
            turning = _rotate(before, axis)
            columns.append([*_cross(turning, tuple(map(_difference, site, anchor))), *turning])
        return quaternion, jnp.stack([jnp.stack(column) for column in columns], axis=1)

    def site(self, qpos: jax.Array) -> jax.Array:
        """Returns the site's position, `[3]`, metres."""
        return self.follow(qpos)[0]

    def follow(
        self, qpos: jax.Array, hinges: list[tuple[_Numbers, _Numbers, _Numbers]] | None = None
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Returns the site's position, `[3]`, and the body's, and its quaternion, `[4]`.

        To `hinges` it adds each one's frame, its axis there, and its anchor.
        """
        model = self._model
        position: _Numbers = (0.0, 0.0, 0.0)
        quaternion: _Numbers = (1.0, 0.0, 0.0, 0.0)
        for body in self._bodies:
            position = _add(position, _rotate(quaternion, _numbers(model.body_pos[body])))
            quaternion = _multiply(quaternion, _numbers(model.body_quat[body]))
            first = int(model.body_jntadr[body])
            for joint in range(first, first + int(model.body_jntnum[body])):
                address = int(model.jnt_qposadr[joint])
                value = _difference(qpos[address], float(model.qpos0[address]))  # MuJoCo's pose is relative to qpos0
                axis, offset = _numbers(model.jnt_axis[joint]), _numbers(model.jnt_pos[joint])
                if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
                    position = _add(position, _rotate(quaternion, _scale(value, axis)))
                    continue
                # A hinge turns the body about its anchor, which stays in place: the body's origin moves around it.
                anchor = _add(position, _rotate(quaternion, offset))
                if hinges is not None:
                    hinges.append((quaternion, axis, anchor))
                turn = (jnp.cos(0.5 * value), *_scale(jnp.sin(0.5 * value), axis))
                quaternion = _multiply(quaternion, turn)
                position = tuple(map(_difference, anchor, _rotate(quaternion, offset)))
        site = _add(position, _rotate(quaternion, self._offset))
        return jnp.stack(site), jnp.stack(position), jnp.stack(quaternion)


def _numbers(array: np.ndarray) -> _Numbers:
    return tuple(float(value) for value in array)


def _product(one: _Number, other: _Number) -> _Number:
    """Multiplies, leaving out constant factors of 0 and 1."""
    for factor, rest in ((one, other), (other, one)):
        if isinstance(factor, float) and factor in (0.0, 1.0):
            return rest if factor else 0.0
    return one * other


def _sum(*terms: _Number) -> _Number:
    """Adds, leaving out constant zeros."""
    kept = [term for term in terms if not _is_zero(term)]
    return functools.reduce(operator.add, kept) if kept else 0.0


def _difference(one: _Number, other: _Number) -> _Number:
    """Subtracts, leaving out constant zeros."""
    if _is_zero(other):
        return one
    return -other if _is_zero(one) else one - other


def _is_zero(number: _Number) -> bool:
    return isinstance(number, float) and number == 0.0


def _scale(factor: _Number, vector: _Numbers) -> _Numbers:
    return tuple(_product(factor, component) for component in vector)


def _add(one: _Numbers, other: _Numbers) -> _Numbers:
    return tuple(map(_sum, one, other))


def _cross(one: _Numbers, other: _Numbers) -> _Numbers:
    a, b, c = one
    d, e, f = other
    return (
        _difference(_product(b, f), _product(c, e)),
        _difference(_product(c, d), _product(a, f)),
        _difference(_product(a, e), _product(b, d)),
    )


def _multiply(one: _Numbers, other: _Numbers) -> _Numbers:
    """Hamilton's product of two quaternions."""
    (a, *u), (b, *v) = one, other
    dot = _sum(*map(_product, u, v))
    return (_difference(_product(a, b), dot), *_add(_add(_scale(a, v), _scale(b, u)), _cross(u, v)))


def _rotate(quaternion: _Numbers, vector: _Numbers) -> _Numbers:
    """Returns a vector turned by a quaternion of length 1, by Rodrigues' formula."""
    real, *imaginary = quaternion
    twice = _scale(2.0, _cross(imaginary, vector))
    return _add(vector, _add(_scale(real, twice), _cross(imaginary, twice)))

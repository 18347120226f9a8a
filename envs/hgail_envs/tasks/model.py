"""A scene's model: its objects, and fields with scaled friction, objects or hand."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from hgail_envs.robots.base import Robot
from hgail_envs.robots.hand import field
from hgail_envs.variation import ModelFactors

ROOM = 0.01
"""Least difference between the widest gap of a narrow hand and the objects' width, metres."""


class SceneModel:
    """A scene's fields, and the indices of its objects, the bodies of its free joints, in them.

    Joints outside the robot that are not free are of parts: drawers, doors, buttons.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot, self._model = robot, robot.model
        model = robot.model
        free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        self.has_object = bool(free.size)
        first_qpos, first_qvel = model.jnt_qposadr[free, None], model.jnt_dofadr[free, None]
        self._bodies = model.jnt_bodyid[free]
        self._geoms = model.body_geomadr[self._bodies]
        self._dofs = first_qvel + np.arange(6)
        self.object_qpos, self.object_qvel = first_qpos + np.arange(3), self._dofs[:, :3]  # [objects, 3]
        root = model.body_rootid[model.site_bodyid[model.site("grip").id]]
        of_arm = model.body_rootid[model.jnt_bodyid] == root
        sizes = np.diff(np.append(model.jnt_qposadr, model.nq))
        self.of_arm_qpos, self.of_arm_qvel = np.repeat(of_arm, sizes), of_arm[model.dof_jntid]
        parts = ~of_arm & (model.jnt_type != mujoco.mjtJoint.mjJNT_FREE)
        self.of_parts_qpos, self.of_parts_qvel = np.repeat(parts, sizes), parts[model.dof_jntid]
        self._object_width = 2.0 * model.geom_size[self._geoms, 0].max(initial=0.0)
        are_cylinders = model.geom_type[self._geoms] == mujoco.mjtGeom.mjGEOM_CYLINDER  # else boxes
        self.object_half_heights = model.geom_size[self._geoms, np.where(are_cylinders, 1, 2)].astype(np.float32)

    def with_room(self, factors: ModelFactors, least: float) -> ModelFactors:
        """Returns factors under which a narrow hand opens to `ROOM` more than the objects' width, and to `least`.

        It opens no wider for that than the scene's own, which may be too narrow for the largest objects;
        all are metres.
        """
        needed = jnp.maximum(self._object_width * factors.object_size + ROOM, least) / self._robot.widest_gap()
        return factors.replace(hand_width=jnp.maximum(factors.hand_width, jnp.minimum(needed, 1.0)))

    def on_table(self, qpos: jax.Array, size: jax.Array | float) -> jax.Array:
        """Returns joint positions, `[nq]`, with objects `size` times as high standing where the nominal ones stood."""
        if not self.has_object:
            return qpos
        return qpos.at[self.object_qpos[:, 2]].add(self.object_half_heights * (size - 1.0))

    def fields(self, factors: ModelFactors) -> dict[str, jax.Array]:
        """Returns the fields that differ, whole arrays by their names in `mujoco.MjModel`.

        Quantities that MuJoCo derives from masses at compilation are scaled consistently, except for the fingers' small
        part in the inverse weights of the arm.
        """
        fields = {"pair_friction": jnp.asarray(self._model.pair_friction) * factors.friction}
        if self.has_object:
            fields |= self._object_fields(factors.object_mass, factors.object_size)
        return fields | self._robot.hand_fields(factors, fields)

    def _object_fields(self, mass: jax.Array | float, size: jax.Array | float) -> dict[str, jax.Array]:
        bodies, geoms, turning = self._bodies, self._geoms, mass * size**2  # inertia is mass times length squared
        of_dof = jnp.array([mass] * 3 + [turning] * 3)
        heavier = self._model.body_mass[bodies] * (mass - 1.0)
        scaled = {
            "body_mass": (bodies, mass),
            "body_inertia": (bodies, turning),
            "body_invweight0": (bodies, jnp.array([1.0 / mass, 1.0 / turning])),
            "dof_invweight0": (self._dofs, 1.0 / of_dof),
            "geom_size": (geoms, size),
            "geom_rbound": (geoms, size),  # else the broad phase would miss contacts of a larger object
            "geom_aabb": (geoms, size),
        }
        fields = {name: field(self._model, name).at[index].multiply(factor) for name, (index, factor) in scaled.items()}
        subtrees = (
            field(self._model, "body_subtreemass").at[bodies].add(heavier).at[0].add(heavier.sum())
        )  # 0 is the world's
        return fields | {"body_subtreemass": subtrees}

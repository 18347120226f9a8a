"""A Fetch scene's model: the arm's start, and fields with scaled friction, object, fingers or pads."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from hgail_envs.variation import ModelFactors

REFERENCE_SUBSTEPS = 20
"""Physics steps per action in the reference: 20 of 2 ms."""
BASE_X = 0.405
"""Position of the robot along x, metres, where a task has no other."""
START_HEIGHT = 0.2
"""Nominal height of the gripper's start above the table, metres, where a task has no other."""
DOWNWARD = np.array([1.0, 0.0, 1.0, 0.0])
"""Quaternion, not normalised, that points the gripper at the table."""
FINGERS = ("right_finger", "left_finger")
"""Names of the fingers' joints and actuators, as their positions are ordered in an observation."""
ROOM = 0.01
"""Least difference between the widest gap of a narrow hand and the objects' width, metres."""

_BASE_Y = 0.48  # metres
_GRIPPER_OFFSET = np.array([-0.498, 0.005, -0.431])  # metres from the gripper's outstretched position to the table
_SETTLE_PERIODS = 10  # actions, as in the reference
_PADS = ("right_pad", "left_pad")
_HEIGHT, _WIDTH = 0, 2  # axes of a pad, along the first of which the gripper points downward; it closes along the other


def settle(
    model: mujoco.MjModel, base_x: float = BASE_X, start_height: float = START_HEIGHT, offset: np.ndarray | float = 0.0
) -> mujoco.MjData:
    """Brings the arm to its start, as the reference does: pulls the gripper there with C MuJoCo and lets it settle.

    See `hgail_envs.fetch.arm.FetchEnv` for `base_x` and `start_height`; `offset`, `[3]`, is a displacement of the
    gripper from its start, metres.
    """
    data = mujoco.MjData(model)
    data.joint("base_x").qpos, data.joint("base_y").qpos = base_x, _BASE_Y
    mujoco.mj_forward(model, data)
    data.mocap_pos[0] = data.site("grip").xpos + _GRIPPER_OFFSET + [0.0, 0.0, start_height]
    data.mocap_pos[0] += offset
    data.mocap_quat[0] = DOWNWARD
    mujoco.mj_step(model, data, nstep=_SETTLE_PERIODS * REFERENCE_SUBSTEPS)
    mujoco.mj_forward(model, data)
    return data


class SceneModel:
    """A scene's fields, and the indices of its objects, the bodies of its free joints, in them."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        self.has_object = bool(free.size)
        first_qpos, first_qvel = model.jnt_qposadr[free, None], model.jnt_dofadr[free, None]
        self._bodies = model.jnt_bodyid[free]
        self._geoms = model.body_geomadr[self._bodies]
        self._dofs = first_qvel + np.arange(6)
        self.object_qpos, self.object_qvel = first_qpos + np.arange(3), self._dofs[:, :3]  # [objects, 3]
        self.of_arm_qpos, self.of_arm_qvel = np.ones(model.nq, bool), np.ones(model.nv, bool)
        self.of_arm_qpos[first_qpos + np.arange(7)] = self.of_arm_qvel[self._dofs] = False
        self._object_width = 2.0 * model.geom_size[self._geoms, 0].max(initial=0.0)
        self._pads = np.array([model.geom(name).id for name in _PADS])
        self._fingers = np.array([model.joint(name).id for name in FINGERS])
        self._widest = model.jnt_range[self._fingers, 1].sum()
        are_cylinders = model.geom_type[self._geoms] == mujoco.mjtGeom.mjGEOM_CYLINDER  # else boxes
        self.object_half_heights = model.geom_size[self._geoms, np.where(are_cylinders, 1, 2)].astype(np.float32)

    def widest_gap(self, factors: ModelFactors | None) -> jax.Array | float:
        """Returns the widest gap between the fingers, `[]`, metres; None is the scene's own model."""
        return self._widest if factors is None else self._widest * factors.hand_width

    def with_room(self, factors: ModelFactors, least: float) -> ModelFactors:
        """Returns factors under which a narrow hand opens to `ROOM` more than the objects' width, and to `least`.

        It opens no wider for that than the scene's own, which may be too narrow for the largest objects;
        all are metres.
        """
        needed = jnp.maximum(self._object_width * factors.object_size + ROOM, least) / self._widest
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
        fields |= self._pad_fields(factors.pad_size, fields)
        if self._model.nu:
            fields |= self._finger_fields(factors.finger_force, factors.finger_speed, fields)
            fields["jnt_range"] = self._field("jnt_range").at[self._fingers, 1].multiply(factors.hand_width)
        return fields

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
        fields = {name: self._field(name).at[index].multiply(factor) for name, (index, factor) in scaled.items()}
        subtrees = self._field("body_subtreemass").at[bodies].add(heavier).at[0].add(heavier.sum())  # 0 is the world's
        return fields | {"body_subtreemass": subtrees}

    def _pad_fields(self, size: jax.Array | float, others: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """Returns the fields that differ for pads `size` times as wide and high, whose lower ends stay in place."""
        pads, axes = self._pads, np.array([_HEIGHT, _WIDTH])
        of_pads = (pads[:, None], axes)
        shorter = self._model.geom_size[pads, _HEIGHT].astype(np.float32) * (1.0 - size)
        sizes = others.get("geom_size", self._field("geom_size")).at[of_pads].multiply(size)
        radii = others.get("geom_rbound", self._field("geom_rbound"))
        boxes = others.get("geom_aabb", self._field("geom_aabb"))  # centres, then half sizes
        return {
            "geom_size": sizes,
            "geom_rbound": radii.at[pads].set(jnp.linalg.norm(sizes[pads], axis=-1)),
            "geom_aabb": boxes.at[pads[:, None], 3 + axes].multiply(size),
            "geom_pos": self._field("geom_pos").at[pads, _HEIGHT].add(shorter),
        }

    def _finger_fields(
        self, force: jax.Array | float, speed: jax.Array | float, others: dict[str, jax.Array]
    ) -> dict[str, jax.Array]:
        """Returns the fields that differ for servos of other force and speed.

        A servo is a mass on a spring with a damper, m x″ + d x′ + k x = k u. With time scaled by `speed` it is
        m / speed², d / speed and k; scaling all three by `force` scales the force alone.
        """
        model = self._model
        dofs = np.array([model.joint(name).dofadr[0] for name in FINGERS])
        servos = np.array([model.actuator(name).id for name in FINGERS])
        heavier = force / speed**2
        mass = model.dof_M0[dofs]
        more = (mass * (heavier - 1.0)).astype(jnp.float32)  # all of it armature: the finger's weight stays
        return {
            "dof_armature": self._field("dof_armature").at[dofs].add(more),
            "dof_damping": self._field("dof_damping").at[dofs].multiply(force / speed),
            "dof_invweight0": others.get("dof_invweight0", self._field("dof_invweight0")).at[dofs].divide(heavier),
            "actuator_gainprm": self._field("actuator_gainprm").at[servos].multiply(force),
            "actuator_biasprm": self._field("actuator_biasprm").at[servos].multiply(force),
        }

    def _field(self, name: str) -> jax.Array:
        return jnp.asarray(getattr(self._model, name), jnp.float32)

"""Fields of a model with other pads and fingers, for a randomisation: whole arrays by their names in `mujoco.MjModel`.

A function is given the fields that already differ, and returns those that it changes.
"""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

PADS = ("right_pad", "left_pad")
"""Names of the pads' geoms."""

_HEIGHT, _WIDTH = 0, 2  # axes of a pad, along the first of which the hand points downward; it closes along the other
_DAMPING = 2  # number of a servo's bias


def pad_fields(model: mujoco.MjModel, size: jax.Array | float, others: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    """Returns the fields that differ for pads `size` times as wide and high, whose lower ends stay in place."""
    pads, axes = np.array([model.geom(name).id for name in PADS]), np.array([_HEIGHT, _WIDTH])
    of_pads = (pads[:, None], axes)
    downward = np.stack([rotation(model.geom_quat[pad])[:, _HEIGHT] for pad in pads]).astype(np.float32)
    shorter = model.geom_size[pads, _HEIGHT].astype(np.float32) * (1.0 - size)
    sizes = others.get("geom_size", field(model, "geom_size")).at[of_pads].multiply(size)
    radii = others.get("geom_rbound", field(model, "geom_rbound"))
    boxes = others.get("geom_aabb", field(model, "geom_aabb"))  # centres, then half sizes
    return {
        "geom_size": sizes,
        "geom_rbound": radii.at[pads].set(jnp.linalg.norm(sizes[pads], axis=-1)),
        "geom_aabb": boxes.at[pads[:, None], 3 + axes].multiply(size),
        "geom_pos": field(model, "geom_pos").at[pads].add(shorter[:, None] * downward),
    }


def finger_fields(
    model: mujoco.MjModel,
    servos: np.ndarray,
    force: jax.Array | float,
    speed: jax.Array | float,
    others: Mapping[str, jax.Array],
) -> dict[str, jax.Array]:
    """Returns the fields that differ for `servos`, by their numbers, of other force and speed.

    A servo is a mass on a spring with a damper, m x″ + d x′ + k x = k u. With time scaled by `speed` it is
    m / speed², d / speed and k; scaling all three by `force` scales the force alone.
    """
    dofs = model.jnt_dofadr[model.actuator_trnid[servos, 0]]
    heavier = force / speed**2
    mass = model.dof_M0[dofs]
    more = (mass * (heavier - 1.0)).astype(jnp.float32)  # all of it armature: the finger's weight stays
    bias = field(model, "actuator_biasprm").at[servos].multiply(force)
    fields = {
        "dof_armature": field(model, "dof_armature").at[dofs].add(more),
        "dof_damping": field(model, "dof_damping").at[dofs].multiply(force / speed),
        "dof_invweight0": others.get("dof_invweight0", field(model, "dof_invweight0")).at[dofs].divide(heavier),
        "actuator_gainprm": field(model, "actuator_gainprm").at[servos].multiply(force),
        "actuator_biasprm": bias.at[servos, _DAMPING].divide(speed),
    }
    if model.actuator_forcelimited[servos].any():
        fields["actuator_forcerange"] = field(model, "actuator_forcerange").at[servos].multiply(force)
    return fields


def field(model: mujoco.MjModel, name: str) -> jax.Array:
    """Returns a field of the model in single precision."""
    return jnp.asarray(getattr(model, name), jnp.float32)


def rotation(quaternion: Sequence[float] | np.ndarray) -> np.ndarray:
    """Returns the rotation matrix, `[3, 3]`, of a quaternion."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, float))
    return matrix.reshape(3, 3)

"""The most forces of joints, by the limits of a model's actuators."""

from collections.abc import Sequence

import mujoco
import numpy as np

from hgail_envs.robots.derivation.given import Given

_OF_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


def for_each(values: Sequence[float], joints: list[int], option: str) -> list[float]:
    """Returns one number for each joint; a ValueError names the option that has another count, or no positive ones."""
    if len(values) not in (1, len(joints)):
        raise ValueError(f"{option} has {len(values)} numbers; give one, or one for each of the {len(joints)} joints")
    if min(values) <= 0.0:
        raise ValueError(f"{option} has {min(values)}; its numbers are greater than 0")
    return [float(value) for value in (list(values) * len(joints) if len(values) == 1 else values)]


def torques(model: mujoco.MjModel, joints: list[int], given: Given) -> list[float]:
    """Returns the most torques of the arm's joints, N m; a ValueError says that they have to be given."""
    if given.torque:
        return for_each(given.torque, joints, "--torque")
    found = [limit_of(model, joint) for joint in joints]
    missing = [model.joint(joint).name for joint, limit in zip(joints, found, strict=True) if not limit]
    if missing:
        raise ValueError(f"the model has no limit of the torque of {', '.join(missing)}; give N m by --torque")
    return [float(limit) for limit in found if limit]


def limit_of(model: mujoco.MjModel, joint: int) -> float | None:
    """Returns the most force of a joint by the limits of its actuators, or its own; None without one."""
    limits = [model.jnt_actfrcrange[joint].max()] if model.jnt_actfrclimited[joint] else []
    for actuator in range(model.nu):
        share = share_of(model, actuator, joint)
        if not share:
            continue
        if model.actuator_forcelimited[actuator]:
            limits.append(abs(share) * np.abs(model.actuator_forcerange[actuator]).max())
        elif model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE and model.actuator_ctrllimited[actuator]:
            gain = abs(model.actuator_gainprm[actuator, 0] * share)
            limits.append(gain * np.abs(model.actuator_ctrlrange[actuator]).max())
    return float(min(limits)) if limits else None


def share_of(model: mujoco.MjModel, actuator: int, joint: int) -> float:
    """Returns the force on a joint by a unit force of an actuator."""
    target, gear = int(model.actuator_trnid[actuator, 0]), float(model.actuator_gear[actuator, 0])
    kind = model.actuator_trntype[actuator]
    if kind in _OF_JOINT:
        return gear if target == joint else 0.0
    if kind != mujoco.mjtTrn.mjTRN_TENDON:
        return 0.0
    wraps = range(model.tendon_adr[target], model.tendon_adr[target] + model.tendon_num[target])
    of_joint = [wrap for wrap in wraps if model.wrap_type[wrap] == mujoco.mjtWrap.mjWRAP_JOINT]
    return gear * sum(float(model.wrap_prm[wrap]) for wrap in of_joint if model.wrap_objid[wrap] == joint)

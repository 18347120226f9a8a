"""What the hand of an arm with servos can hold: its gap and force by its drives, and the weight of objects."""

import functools
from typing import NamedTuple

import mujoco
import numpy as np

from hgail_envs.robots.arm_model import PREFIX, attach_arm
from hgail_envs.robots.description import read_description, text_of
from hgail_envs.robots.hand import PADS

WEIGHT_PER_FORCE = 0.1
"""Most weight of an object for a force with which each pad presses on it.

Two pads with a friction of 1 carry twenty times that at rest, and a 2F-85's thirteen times. A full action accelerates
it by three or four g, and at twice the weight a script drops the cube in 3 to 6 % of its pick and place.
"""

_LEAST_MASS = 0.02  # kg of an object worth holding
_OPENINGS = 9  # of the hand, at which its joints and its gap are tabulated
_SETTLE_STEPS = 400


class HandTable(NamedTuple):
    """A hand at several openings, from closed to open, in the scene's metres."""

    closed: np.ndarray
    """`[drives]`: positions of the driven joints when it is closed."""
    opened: np.ndarray
    """`[drives]`: the same when it is open."""
    gaps: np.ndarray
    """`[openings]`: distances between the pads, metres."""
    openings: np.ndarray
    """`[openings, joints]`: positions of all joints of the hand, in the model's order."""
    forces: np.ndarray
    """`[openings]`: with which each pad presses on an object as wide as the gap when the hand is to close, N."""
    depth: float
    """Greatest distance of the pads' ends below the gripper, metres."""


def tabulate_hand(name: str) -> HandTable:
    """Opens the hand of an arm by C MuJoCo; `name` is that of a description, see `read_description`."""
    return _tabulated(name, text_of(name))


@functools.cache
def _tabulated(name: str, text: str) -> HandTable:
    del text  # the cache's
    arm, model = read_description(name), _arm_alone(name)
    data, pads, tool = mujoco.MjData(model), [model.site(pad).id for pad in PADS], model.site("grip").id
    joints = [model.joint(PREFIX + joint).id for joint in arm.joints]
    drives = [model.joint(PREFIX + joint).id for joint in arm.hand.joints]
    unit = np.where(model.jnt_type[drives] == mujoco.mjtJoint.mjJNT_SLIDE, arm.scale, 1.0)
    closed, opened = unit * arm.hand.closed, unit * arm.hand.opened
    of_hand = model.jnt_qposadr[[joint for joint in range(model.njnt) if joint not in joints]]
    data.qpos[model.jnt_qposadr[joints]] = arm.home
    sizes = arm.scale * np.array([getattr(arm, pad).size for pad in PADS])
    gaps, openings, driven, depth = [], [], [], 0.0
    for share in np.linspace(0.0, 1.0, _OPENINGS):
        data.ctrl[:] = [*arm.home, *(closed + share * (opened - closed))]
        mujoco.mj_step(model, data, nstep=_SETTLE_STEPS)
        mujoco.mj_kinematics(model, data)
        places = (data.site_xpos[pads] - data.site_xpos[tool]) @ data.site_xmat[tool].reshape(3, 3)
        depth = max(depth, float((places[:, 0] + sizes[:, 0]).max()))
        gaps.append(places[0, 1] - places[1, 1] - sizes[:, 1].sum())
        openings.append(data.qpos[of_hand])
        driven.append(data.qpos[model.jnt_qposadr[drives]])
    forces = _pressing(model, np.array(driven), closed, np.array(gaps))
    single = [np.asarray(rows, np.float32) for rows in (closed, opened, gaps, openings, forces)]
    return HandTable(single[0], single[1], single[2], single[3], single[4], depth)


def _pressing(model: mujoco.MjModel, driven: np.ndarray, closed: np.ndarray, gaps: np.ndarray) -> np.ndarray:
    """Returns each pad's force, `[openings]`, N: what the drives do for a small closing, the pads do over the gap."""
    servos = np.arange(model.nu - len(closed), model.nu)
    pull = model.actuator_gainprm[servos, 0] * np.abs(driven - closed)
    efforts = np.minimum(model.actuator_forcerange[servos, 1], pull)
    return (efforts * np.abs(np.gradient(driven, gaps, axis=0))).sum(axis=1)


def _arm_alone(name: str) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    attach_arm(name, spec, [0.0, 0.0, 0.0])
    return spec.compile()


def without_weight_beyond_grip(model: mujoco.MjModel, name: str) -> mujoco.MjModel:
    """Makes the bodies of free joints no heavier than `WEIGHT_PER_FORCE` allows a hand, and returns the model.

    Nor are they heavier than the arm's `payload`.

    A ValueError says that an object is too wide for the hand, or that the hand is too weak for any.
    """
    table, payload, lightened = tabulate_hand(name), read_description(name).payload, False
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        body = model.jnt_bodyid[joint]
        width, title = 2.0 * float(model.geom_size[model.body_geomadr[body], 0]), model.body(body).name
        if width > table.gaps[-1]:
            widest = f"robot {name!r} opens its hand to {1000 * table.gaps[-1]:.0f} mm"
            raise ValueError(f"{widest}, and {title!r} is {1000 * width:.0f} mm wide")
        force = float(np.interp(width, table.gaps, table.forces))
        most = min(WEIGHT_PER_FORCE * force / float(np.linalg.norm(model.opt.gravity)), payload)
        if most < _LEAST_MASS:
            raise ValueError(
                f"robot {name!r} presses on {title!r} with {force:.2g} N, which holds {1000 * most:.2g} g;"
                f" an object has at least {1000 * _LEAST_MASS:.0f} g"
            )
        share = min(1.0, most / model.body_mass[body])
        model.body_mass[body] *= share
        model.body_inertia[body] *= share
        lightened |= share < 1.0
    if lightened:
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model

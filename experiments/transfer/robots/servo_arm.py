"""Arms with servos in place of the Fetch; `arms` has their parameters."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import mujoco
import numpy as np

from experiments.transfer.robots.arms import FRANKA, UR5E, Arm
from experiments.transfer.robots.base import OptionCurve, Robot
from experiments.transfer.robots.responses import FingerResponse, GripperResponse
from hgail_envs.registry import find_class
from hgail_envs.robots.base import CONTROL_PERIOD, REFERENCE_SUBSTEPS
from hgail_envs.robots.fetch import Fetch
from hgail_envs.scenes import TABLE_HEIGHT
from hgail_envs.tasks import grasp
from hgail_envs.tasks.arm import LEAST_DISTANCE
from hgail_envs.tasks.pick_and_place import HIGHEST
from hgail_envs.tasks.reach import GOAL_RANGE
from hgail_envs.validation import check_count

_SCENES = {"reach": "reach", "grasp": "grasp", "pick-and-place": "grasp"}
_SERVO_STEPS = 4  # physics steps, 8 ms, between two commands to the servos
_SETTLE_STEPS = 1000  # physics steps
_MOST_SLOWDOWN = 100  # actions of 4 s


class ServoArm(Robot):
    """An arm, its hand pointing downward, in front of a table as high as the Fetch's.

    The policy's frame is shifted so that the tool starts where the Fetch's gripper starts. Cubes, points to reach and
    places to bring the cube to are drawn as the Fetch scenes draw them.

    The tool and the hand track the Fetch's responses to the same action (`responses`), as fast as the models' servos
    can. The features are those of `Reach`, `Grasp` and `PickAndPlace`: velocities are multiplied by the duration of an
    action. The gap is that of the hand's own pads, taken from the drive. In reach the hand stays closed.

    Hands are narrower and slower than the Fetch's: the 2F-85 opens to 85 mm instead of 100, and takes 240 ms for nine
    tenths of it instead of 80. So an action lasts `slowdown` times longer. With actions as fast as the Fetch's the hand
    hardly opens on the way; let it start open. A hand that is wide open is led on to the Fetch's 100 mm, and so begins
    to close up to an action later than a Fetch's that is no wider.

    A subclass sets `arm`.

    Args:
      task: `"reach"`, `"grasp"` or `"pick-and-place"`.
      slowdown: duration of an action, times `CONTROL_PERIOD`; None is the arm's default.
      start_open: start with an open hand in tasks with a cube, unlike the Fetch.

    Raises:
      ValueError: an option is out of range.
    """

    arm: ClassVar[Arm]
    """Parameters of the arm."""
    tasks = tuple(_SCENES)
    curves = tuple(
        OptionCurve(
            quantity="slowdown",
            axis="time of an action, times the trained one",
            line=f"hand {hand}",
            task="grasp",
            option="slowdown",
            values=(1, 2, 3, 4),
            fixed={"start_open": hand == "open"},
        )
        for hand in ("closed", "open")
    )

    cube = "cube"
    marker = "target"

    def __init_subclass__(cls) -> None:
        cls.name, cls.extra, cls.packages = cls.arm.name, cls.arm.extra, cls.arm.packages

    def __init__(self, task: str, slowdown: int | None = None, start_open: bool = False) -> None:
        # Here, so that the class can be read without its extra.
        from experiments.transfer.robots.arms import TOOL_CENTRE, load_arm, load_cell
        from experiments.transfer.robots.inverse_kinematics import DownwardArm

        arm = self.arm
        if slowdown is not None:
            check_count("slowdown", slowdown, most=_MOST_SLOWDOWN)
        if not isinstance(start_open, bool):
            raise ValueError(f"start_open is {start_open!r}; it must be true or false")
        self.task, self.slowdown = task, arm.slowdown if slowdown is None else slowdown
        self.starts_closed = task == "reach" or not start_open
        start = Fetch(_SCENES[task]).settle().site("grip").xpos
        self.offset = np.array([*(start[:2] - arm.workspace), TABLE_HEIGHT])  # its own table's top is at 0
        self._start = start - self.offset
        self.model = load_cell(arm, cube=task != "reach")
        self.data = mujoco.MjData(self.model)
        self._find(TOOL_CENTRE)
        self._ik = DownwardArm(load_arm(arm), TOOL_CENTRE, arm.downward, arm.top_speed, arm.posture_cost)
        self._ik.joints = np.array(arm.near_start)
        self._ik.move_to(self._start)
        self._home = self._ik.joints
        self._settled = self._settle()
        self._goal = self._start

    def _find(self, tool: str) -> None:
        """Looks up the indices of the parts in the model."""
        model, hand = self.model, self.arm.hand
        self._site = model.site(tool).id
        self._cube = model.geom(self.cube).id if self.task != "reach" else -1
        self._drive = int(model.joint(hand.drive).qposadr[0])
        bodies = [model.body(name).id for name in hand.pads]
        self._pads = [set(np.flatnonzero(model.geom_bodyid == body)) for body in bodies]
        self._jacobian = np.zeros((3, model.nv))

    @classmethod
    def variants(cls, task: str) -> Sequence[Mapping[str, Any]]:
        """Returns the options of its rows in the table: slow, as fast as the Fetch, and slow with an open hand."""
        if task == "reach":
            return [{}, {"slowdown": 1}]
        return [{}, {"slowdown": 1, "start_open": True}, {"start_open": True}]

    def reset(self, rng: np.random.Generator) -> None:
        """Starts an episode with a random cube on the table or point to reach, and a random goal of the cube."""
        mujoco.mj_copyData(self.data, self.model, self._settled)
        if self.task == "reach":
            self._goal = self._start + rng.uniform(-GOAL_RANGE, GOAL_RANGE, 3)
        else:
            shift = np.zeros(2)
            while np.linalg.norm(shift) < LEAST_DISTANCE:
                shift = rng.uniform(-grasp.CUBE_RANGE, grasp.CUBE_RANGE, 2)
            self.data.joint("cube").qpos[:3] = [*(self._start[:2] + shift), grasp.CUBE_WIDTH / 2]
        if self.task == "pick-and-place":
            place = self._start[:2] + rng.uniform(-GOAL_RANGE, GOAL_RANGE, 2)
            self._goal = np.array([*place, grasp.CUBE_WIDTH / 2 + rng.integers(2) * rng.uniform(0.0, HIGHEST)])
        mujoco.mj_forward(self.model, self.data)
        self._ik.joints = self._home
        self._gripper = GripperResponse(self._position())
        self._fingers = FingerResponse(self._gap())

    def features(self) -> np.ndarray:
        """Returns the features of `Reach`, `[6]`, `Grasp`, `[8]`, or `PickAndPlace`, `[17]`."""
        mujoco.mj_jacSite(self.model, self.data, self._jacobian, None, self._site)
        period = self.slowdown * CONTROL_PERIOD
        position, velocity = self._position() + self.offset, self._jacobian @ self.data.qvel * period
        known = {"gripper position": position, "gripper velocity": velocity}
        if self.task != "reach":
            cube, gap = self._cube_position(), self._gap()
            known |= {
                "gap between the fingers": gap,
                "hand holds the cube": grasp.is_held(self._touching(), gap),
                "cube position less gripper position": cube - position,
                "cube position": cube,
                "cube velocity": self.data.joint("cube").qvel[:3] * period,
            }
        layout = find_class(self.task).features_layout
        return layout.join({quantity.name: known[quantity.name] for quantity in layout}, np)

    def target(self) -> np.ndarray:
        """Returns the point to reach, the cube's centre in grasp, or its goal, `[3]`."""
        return self._cube_position() if self.task == "grasp" else self._goal + self.offset

    def carried(self) -> np.ndarray:
        """Returns the tool's position, or the cube's in pick-and-place, `[3]`."""
        return self._cube_position() if self.task == "pick-and-place" else self._position() + self.offset

    def step(self, action: np.ndarray) -> None:
        """Moves the arm and the hand for `slowdown` times `CONTROL_PERIOD`, by an action, `[4]`."""
        target = self._gripper.lead(self._position(), action[:3])
        # The Fetch's pads rest on the table, while these servos would keep pressing.
        target[2] = max(target[2], self.arm.hand.below_tool)
        finger = self._fingers.lead(self._gap(), action[3])
        commands = self.slowdown * REFERENCE_SUBSTEPS // _SERVO_STEPS
        fetch_time = CONTROL_PERIOD / commands  # `slowdown` times shorter than on this arm
        period, lag = _SERVO_STEPS * self.model.opt.timestep, np.array(self.arm.lag)
        for _ in range(commands):
            self._gripper.follow(target, fetch_time)
            before = self._ik.joints
            velocity = self._ik.approach(self._gripper.position, period)
            self.data.ctrl[: self.arm.joints] = before + (period + lag) * velocity
            if self.task != "reach":
                self.data.ctrl[self.arm.joints :] = self._hand_control(finger, fetch_time)
            mujoco.mj_step(self.model, self.data, nstep=_SERVO_STEPS)
        mujoco.mj_forward(self.model, self.data)

    def _hand_control(self, finger: float, time: float) -> float:
        """Returns the hand's control once the Fetch's fingers have moved towards `finger`, metres, for `time`."""
        before = self._drive_at(self._fingers.gap)
        self._fingers.follow(finger, time)
        drive = self._drive_at(self._fingers.gap)
        rate = (drive - before) / (_SERVO_STEPS * self.model.opt.timestep)
        return float(np.interp(self._closed(drive + self.arm.hand.lag * rate), [0.0, 1.0], self.arm.hand.control_range))

    def _closed(self, drive: float) -> float:
        """Returns the closing of the hand with its drive at `drive`: 0 is open, 1 closed."""
        opened, closed = self.arm.hand.drive_range
        return (drive - opened) / (closed - opened)

    def _drive_at(self, gap: float) -> float:
        """Returns the drive's position at which the pads are this far apart, metres, or as far as they go."""
        opened, closed = self.arm.hand.drive_range
        return opened + (closed - opened) * (1.0 - min(gap / self.arm.hand.widest_gap, 1.0))

    def _gap(self) -> float:
        """Returns the gap between the pads, metres."""
        return self.arm.hand.widest_gap * (1.0 - self._closed(self.data.qpos[self._drive]))

    def _cube_position(self) -> np.ndarray:
        """Returns the cube's centre, `[3]`, metres, in the policy's frame."""
        return self.data.geom_xpos[self._cube] + self.offset

    def _position(self) -> np.ndarray:
        """Returns the tool's position, `[3]`, metres, in the scene's world frame."""
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
        data.ctrl[: self.arm.joints] = self._home
        data.ctrl[self.arm.joints :] = self.arm.hand.control_range[self.starts_closed]
        mujoco.mj_step(self.model, data, nstep=_SETTLE_STEPS)
        return data


class UR5e(ServoArm):
    """A UR5e with a Robotiq 2F-85."""

    arm = UR5E


class Franka(ServoArm):
    """A Franka Panda with its own hand."""

    arm = FRANKA

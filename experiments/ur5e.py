"""A UR5e with a Robotiq 2F-85, on C MuJoCo, as a robot for a policy trained on the Fetch."""

import mink
import mujoco
import numpy as np
from ur5e_model import DRIVE, PADS, TOOL_CENTRE, load_arm, load_cell

from envs.fetch import ACCURATE_SUBSTEPS, CONTROL_PERIOD, settle
from envs.grasp import CUBE_RANGE, CUBE_WIDTH, LEAST_DISTANCE, is_held
from envs.reach import GOAL_RANGE
from envs.scenes import load_scene

STRIDE = 0.033
"""Metres that a unit action moves the tool's target, as it moves the Fetch's gripper once up to speed."""
WIDEST_GAP = 0.085
"""Metres between the pads of the open hand."""

_TABLE = 0.4  # metres, the height of the table's top in the Fetch scene; here it is 0
_WORKSPACE = np.array([0.5, 0.0])  # metres in front of the base, what stands for x and y of the Fetch's start
_NEAR_START = np.array([-3.413, -1.466, 2.001, -2.105, -1.571, -3.413])  # radians, elbow up
_DOWNWARD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # the hand closes along y, as the Fetch's
_FASTEST = np.pi  # radians a second, of each joint, by the maker's data sheet
_LEASH = 0.05  # metres that the tool's target may be ahead of the tool, e.g. when it is pressed on the table
_FEED_FORWARD = 0.2  # seconds: damping over stiffness of the model's servos, which lag behind by as much
_DAMPING = 1e-8  # of inverse kinematics
_OPEN_TO_CLOSED = 255.0  # range of the hand's control
_CLOSED = 0.8  # radians, where the drive has closed the hand
_SETTLE_STEPS = 1000


class Tool:
    """The tool's target, and the joint positions that bring the tool there: differential inverse kinematics by mink."""

    def __init__(self) -> None:
        arm = load_arm()
        self._configuration = mink.Configuration(arm)
        self._task = mink.FrameTask(TOOL_CENTRE, "site", position_cost=1.0, orientation_cost=1.0)
        speeds = {arm.joint(index).name: _FASTEST for index in range(arm.njnt)}
        self._limits = [mink.ConfigurationLimit(arm), mink.VelocityLimit(arm, speeds)]

    def start(self, position: np.ndarray) -> np.ndarray:
        """Returns the joint positions, `[6]`, at which the tool is at `position`, `[3]`, and points downward."""
        self._configuration.update(_NEAR_START.copy())
        for _ in range(20):
            self.lead_to(position)
        return self.joints()

    def lead_to(self, position: np.ndarray) -> np.ndarray:
        """Moves the joint positions towards a target; returns the velocities, `[6]`, for one `CONTROL_PERIOD`."""
        orientation = mink.SO3.from_matrix(_DOWNWARD)
        self._task.set_target(mink.SE3.from_rotation_and_translation(orientation, position))
        velocity = mink.solve_ik(
            self._configuration, [self._task], CONTROL_PERIOD, "daqp", damping=_DAMPING, limits=self._limits
        )
        self._configuration.integrate_inplace(velocity, CONTROL_PERIOD)
        return velocity

    def joints(self) -> np.ndarray:
        """Returns the joint positions, `[6]`, radians."""
        return self._configuration.q.copy()

    def place(self, joints: np.ndarray) -> None:
        """Sets the joint positions, `[6]`."""
        self._configuration.update(joints.copy())


class UR5e:
    """The UR5e as a `Robot`; see there for the methods.

    The policy's frame is shifted so that the tool's start is where the Fetch's gripper starts, above a table as high.
    Starts and targets are drawn as the Fetch scenes draw them, the hand closed and pointing downward.

    An action moves the tool's target by `STRIDE` for each unit; the joints follow in a straight line, at their rated
    speed at most. The hand's number leads each finger by as many metres as that of the Fetch, within the hand's
    range; it is closed in reach. The features are those of `Reach` and `Grasp`: the velocity is multiplied by
    `CONTROL_PERIOD`, the gap is the distance between the pads.

    Args:
      task: `"reach"` or `"grasp"`.

    """

    def __init__(self, task: str):
        self.task = task
        start = settle(load_scene(f"fetch/{task}")).site("grip").xpos
        self.offset = np.array([*(start[:2] - _WORKSPACE), _TABLE])
        self._start = start - self.offset
        self.model = load_cell()
        self.data = mujoco.MjData(self.model)
        self._tool = Tool()
        self._home = self._tool.start(self._start)
        self._site = self.model.site(TOOL_CENTRE).id
        self._cube = self.model.geom("cube").id
        self._pads = [[self.model.geom(name).id for name in pad] for pad in PADS]
        self._jacobian = np.zeros((3, self.model.nv))
        self._target = self._goal = self._start
        self._settled = self._settle()

    def reset(self, rng: np.random.Generator) -> None:
        """Starts an episode: the cube on the table, or the point to reach, at random."""
        self._tool.place(self._home)
        self._target = self._start
        mujoco.mj_copyData(self.data, self.model, self._settled)
        if self.task == "reach":
            self._goal = self._start + rng.uniform(-GOAL_RANGE, GOAL_RANGE, 3)
        else:
            shift = np.zeros(2)
            while np.linalg.norm(shift) < LEAST_DISTANCE:
                shift = rng.uniform(-CUBE_RANGE, CUBE_RANGE, 2)
            self.data.joint("cube").qpos[:3] = [*(self._start[:2] + shift), CUBE_WIDTH / 2]
        mujoco.mj_forward(self.model, self.data)

    def features(self) -> np.ndarray:
        """Returns the features of `Reach`, `[6]`, or `Grasp`, `[8]`."""
        mujoco.mj_jacSite(self.model, self.data, self._jacobian, None, self._site)
        velocity = self._jacobian @ self.data.qvel * CONTROL_PERIOD
        arm = np.concatenate([self._position() + self.offset, velocity])
        if self.task == "reach":
            return arm
        return np.append(arm, [self.gap(), is_held(self._touching(), self.gap())])

    def target(self) -> np.ndarray:
        """Returns the point to reach, or the cube's centre, `[3]`."""
        return (self._goal if self.task == "reach" else self.data.geom_xpos[self._cube]) + self.offset

    def gap(self) -> float:
        """Returns the hand's opening by its drive, as the real hand reports it, metres."""
        return WIDEST_GAP * (1.0 - float(self.data.joint(DRIVE).qpos[0]) / _CLOSED)

    def step(self, action: np.ndarray) -> None:
        """Moves the arm and the hand for `CONTROL_PERIOD`."""
        here, before = self._position(), self._tool.joints()
        ahead = self._target + STRIDE * action[:3] - here
        self._target = here + np.clip(ahead, -_LEASH, _LEASH)
        velocity = self._tool.lead_to(self._target)
        gap = 0.0 if self.task == "reach" else np.clip(self.gap() + 2.0 * action[3], 0.0, WIDEST_GAP)
        self.data.ctrl[6] = _OPEN_TO_CLOSED * (1.0 - gap / WIDEST_GAP)
        for substep in range(ACCURATE_SUBSTEPS):
            time = (substep + 1) * CONTROL_PERIOD / ACCURATE_SUBSTEPS
            self.data.ctrl[:6] = before + (time + _FEED_FORWARD) * velocity
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)

    def _position(self) -> np.ndarray:
        return self.data.site_xpos[self._site].copy()

    def _touching(self) -> bool:
        pairs = self.data.contact.geom
        touched = set(pairs[(pairs == self._cube).any(axis=1)].ravel())
        return all(not touched.isdisjoint(pad) for pad in self._pads)

    def _settle(self) -> mujoco.MjData:
        """Returns the robot at rest with a closed hand."""
        data = mujoco.MjData(self.model)
        for index, position in enumerate(self._home):
            data.qpos[self.model.jnt_qposadr[self.model.actuator_trnid[index, 0]]] = position
        data.ctrl[:] = [*self._home, _OPEN_TO_CLOSED]
        mujoco.mj_step(self.model, data, nstep=_SETTLE_STEPS)
        return data

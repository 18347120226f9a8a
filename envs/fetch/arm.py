"""What all Fetch tasks share: the arm, its start and its end-effector control.

The reference is Gymnasium-Robotics' `fetch_env.py` and `robot_env.py` (v4, C MuJoCo).
"""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import GoalEnv
from envs.engines import Control, EngineState, make_engine
from envs.fetch.kinematics import Chain
from envs.scenes import load_scene

CONTROL_PERIOD = 0.04
"""Seconds between two actions."""
ACCURATE_SUBSTEPS = 20
"""Physics steps per action in the reference: 20 of 2 ms."""
FAST_SUBSTEPS = 4
"""The fewest physics steps per action, 4 of 10 ms: the gripper's weld, of time constant 20 ms, bears no longer ones."""

TABLE_HEIGHT = 0.4
"""Metres from the floor to the table's top, in every Fetch scene."""

LEAD = 0.05
"""Metres that the mocap body leads the gripper by for a unit action."""

_DOWNWARD = np.array([1.0, 0.0, 1.0, 0.0])  # quaternion (not normalised) that points the gripper at the table
_FINGERS = ("right_finger", "left_finger")
_BASE_POSITION = {"base_x": 0.405, "base_y": 0.48}  # metres
_GRIPPER_OFFSET = np.array([-0.498, 0.005, -0.231])  # metres from the gripper's outstretched position to its start
_SETTLE_PERIODS = 10


class FetchPhysics(EngineState):
    """What the engine carries from one action to the next, and what is seen of it."""

    steps: jax.Array
    """`[]` integer: actions taken in the episode."""
    body_position: jax.Array
    """`[3]`: the gripper's body, which the mocap body leads."""
    body_quaternion: jax.Array
    """`[4]`: the same body's orientation."""
    gripper_position: jax.Array
    """`[3]`: the point between the fingers, metres, world frame."""
    gripper_velocity: jax.Array
    """`[3]`: its linear velocity times `CONTROL_PERIOD`, metres, as the reference has it."""


class FetchEnv(GoalEnv):
    """The Fetch arm, its gripper pulled by a mocap body through a weld constraint.

    An action is four numbers in [-1, 1]: three end-effector displacements (x, y, z; a unit moves the gripper about
    33 mm once it is up to speed) and the gripper command. The physics state is a `FetchPhysics`.

    A task sets `scene` and the attributes of a `GoalEnv`.

    Args:
      impl: physics engine, see `envs.engines.resolve_impl`: `"auto"`, `"warp"`, `"c"` or `"jax"`.
      substeps: physics steps per action, from `FAST_SUBSTEPS` to `ACCURATE_SUBSTEPS`; an action always lasts
        `CONTROL_PERIOD`.
      worlds: environments that are stepped at once at most; MJX-Warp sizes its contact buffers by it.

    Raises:
      ValueError: an unknown or unavailable `impl`, or a number out of range.

    """

    scene: str
    episode_length = 50
    action_size = 4
    control_period = CONTROL_PERIOD
    success_threshold = 0.05
    observation_limit = 10.0  # metres; the arm reaches hardly 2 m from the origin

    def __init__(self, impl: str = "auto", substeps: int = ACCURATE_SUBSTEPS, worlds: int = 4096) -> None:
        if not (isinstance(substeps, int) and FAST_SUBSTEPS <= substeps <= ACCURATE_SUBSTEPS):
            raise ValueError(
                f"substeps is {substeps!r}; it must be an integer from {FAST_SUBSTEPS} to {ACCURATE_SUBSTEPS}"
            )
        if not (isinstance(worlds, int) and worlds >= 1):
            raise ValueError(f"worlds is {worlds}; it must be an integer of at least 1")
        self.model = load_scene(self.scene)
        self._finger_qpos = self.model.jnt_qposadr[[self.model.joint(name).id for name in _FINGERS]]
        settled = settle(self.model)
        self.initial_gripper_position = settled.site("grip").xpos.copy()
        self.engine = make_engine(impl, self.model, CONTROL_PERIOD, substeps, worlds)
        self.max_worlds = self.engine.max_worlds
        self._arm = Chain(self.model, "grip")  # MJX-Warp exposes no velocities
        self._initial_physics = jax.jit(self.place)(settled.qpos, settled.qvel)

    @property
    def impl(self) -> str:
        """The engine's name."""
        return self.engine.name

    @property
    def substeps(self) -> int:
        """Physics steps per action."""
        return self.engine.substeps

    def accurate(self) -> "FetchEnv":
        """Returns the task with `ACCURATE_SUBSTEPS`."""
        env = copy.copy(self)
        env.engine = self.engine.with_substeps(ACCURATE_SUBSTEPS)
        return env

    def reset_physics(self, rng: jax.Array) -> FetchPhysics:
        del rng  # the arm always starts from the same pose
        return self._initial_physics

    def overflow(self, physics: FetchPhysics) -> jax.Array:
        return physics.overflow

    def place(self, qpos: jax.Array, qvel: jax.Array) -> FetchPhysics:
        """Returns the physics with joint positions `[nq]` and velocities `[nv]`, without a history."""
        return self._see(
            FetchPhysics(
                qpos=jnp.asarray(qpos, jnp.float32),
                qvel=jnp.asarray(qvel, jnp.float32),
                warmstart=jnp.zeros(self.model.nv),
                sensordata=jnp.zeros(self.model.nsensordata),
                overflow=jnp.zeros((), bool),
                steps=jnp.zeros((), jnp.int32),
                body_position=jnp.zeros(3),
                body_quaternion=jnp.zeros(4),
                gripper_position=jnp.zeros(3),
                gripper_velocity=jnp.zeros(3),
            )
        )

    def control(self, physics: FetchPhysics, displacement: jax.Array, grip: jax.Array | None = None) -> Control:
        """Returns what acts on the scene during an action.

        Args:
          physics: where from.
          displacement: `[3]` in [-1, 1], where the mocap body pulls the gripper.
          grip: `[]` in [-1, 1], metres by which the fingers' servos lead the fingers; None in a scene without servos.

        """
        return Control(
            mocap_pos=(physics.body_position + LEAD * displacement)[None],
            mocap_quat=(physics.body_quaternion + _DOWNWARD)[None],
            ctrl=jnp.zeros(self.model.nu) if grip is None else physics.qpos[self._finger_qpos] + grip,
        )

    def _move(self, physics: FetchPhysics, displacement: jax.Array, grip: jax.Array | None = None) -> FetchPhysics:
        """Carries out an action; see `control` for the arguments. Without servos the fingers stay closed."""
        moved = self.engine.step(physics, self.control(physics, displacement, grip))
        if grip is None:
            moved = moved.replace(qpos=moved.qpos.at[self._finger_qpos].set(0.0))
        return self._see(moved.replace(steps=physics.steps + 1))

    def _see(self, physics: FetchPhysics) -> FetchPhysics:
        """Returns the physics with the gripper where the joints put it."""
        gripper = self._arm.pose(physics.qpos, physics.qvel)
        return physics.replace(
            body_position=gripper.body_position,
            body_quaternion=gripper.body_quaternion,
            gripper_position=gripper.site_position,
            gripper_velocity=gripper.site_velocity * CONTROL_PERIOD,
        )


def settle(model: mujoco.MjModel) -> mujoco.MjData:
    """Brings the arm to its start, as the reference does: pull the gripper there with C MuJoCo and let it settle."""
    data = mujoco.MjData(model)
    for joint, position in _BASE_POSITION.items():
        data.joint(joint).qpos = position
    mujoco.mj_forward(model, data)
    data.mocap_pos[0] = data.site("grip").xpos + _GRIPPER_OFFSET
    data.mocap_quat[0] = _DOWNWARD
    mujoco.mj_step(model, data, nstep=_SETTLE_PERIODS * ACCURATE_SUBSTEPS)
    mujoco.mj_forward(model, data)
    return data

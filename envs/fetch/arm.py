"""What all Fetch tasks share: the arm on MJX and its end-effector control.

The reference is Gymnasium-Robotics' `fetch_env.py` and `robot_env.py` (v4, C MuJoCo).
"""

import copy
import importlib.util
import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from mujoco import mjx

from envs.base import GoalEnv
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
_HIGHEST_START = 0.15  # metres above the usual start; the arm reaches no higher in the whole workspace


@jax.jit  # traced once, whatever loops and batches it is then run in
def _engine_step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Takes a physics step, in full single precision: by default GPUs round what they multiply to ten bits."""
    with jax.default_matmul_precision("highest"):
        return mjx.step(model, data)


class FetchPhysics(struct.PyTreeNode):
    """What the simulation carries from one action to the next, and what is seen of it."""

    steps: jax.Array
    """`[]` integer: actions taken in the episode."""
    qpos: jax.Array
    """`[nq]`: joint positions."""
    qvel: jax.Array
    """`[nv]`: joint velocities."""
    warmstart: jax.Array
    """`[nv]`: accelerations of the last step, where the constraint solver starts."""
    sensordata: jax.Array
    """`[nsensordata]`: as of the last physics step."""
    overflow: jax.Array
    """`[]` boolean: whether contacts or constraints ever exceeded their buffers (MJX-Warp alone has such)."""
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

    Args:
      scene: the scene's name, e.g. `"fetch/reach"`.
      impl: physics implementation: `"auto"` (MJX-Warp on a GPU where warp-lang is installed, else MJX-JAX), `"jax"`
        or `"warp"`.
      substeps: physics steps per action, from `FAST_SUBSTEPS` to `ACCURATE_SUBSTEPS`; an action always lasts
        `CONTROL_PERIOD`.
      worlds: environments that are stepped at once at most; MJX-Warp sizes its contact buffers by it.
      raise_start: metres by which the gripper starts above its usual place.

    Raises:
      ValueError: an unknown or unavailable `impl`, or a number out of range.

    """

    episode_length = 50
    action_size = 4
    success_threshold = 0.05
    observation_limit = 10.0  # metres; the arm reaches hardly 2 m from the origin

    def __init__(
        self,
        scene: str,
        impl: str = "auto",
        substeps: int = ACCURATE_SUBSTEPS,
        worlds: int = 4096,
        raise_start: float = 0.0,
    ):
        if not FAST_SUBSTEPS <= substeps <= ACCURATE_SUBSTEPS:
            raise ValueError(f"substeps is {substeps}; it must be from {FAST_SUBSTEPS} to {ACCURATE_SUBSTEPS}")
        if worlds < 1:
            raise ValueError(f"worlds is {worlds}; it must be at least 1")
        if not 0.0 <= raise_start <= _HIGHEST_START:
            raise ValueError(f"raise_start is {raise_start}; it must be from 0 to {_HIGHEST_START} m")
        self.scene, self.impl = scene, resolve_impl(impl)
        self.substeps = substeps
        self.model = load_scene(scene)
        self._finger_qpos = self.model.jnt_qposadr[[self.model.joint(name).id for name in _FINGERS]]
        settled = settle(self.model, raise_start)
        self.initial_gripper_position = settled.site("grip").xpos.copy()
        self.model.opt.timestep = CONTROL_PERIOD / substeps
        self.engine_model = mjx.put_model(self.model, impl=self.impl)
        sizes = buffer_sizes(self.model, worlds) if self.impl == "warp" else {}
        self._blank_data = _make_blank_data(self.model, self.impl, sizes)
        self._arm = Chain(self.model, "grip")  # MJX-Warp exposes no velocities
        self._initial_physics = jax.jit(self.place)(settled.qpos, settled.qvel)

    def accurate(self) -> "FetchEnv":
        """Returns the task with `ACCURATE_SUBSTEPS`."""
        env = copy.copy(self)
        env.substeps = ACCURATE_SUBSTEPS
        timestep = jnp.float32(CONTROL_PERIOD / ACCURATE_SUBSTEPS)
        env.engine_model = self.engine_model.tree_replace({"opt.timestep": timestep})
        return env

    def reset_physics(self, rng: jax.Array) -> FetchPhysics:
        del rng  # the arm always starts from the same pose
        return self._initial_physics

    def overflow(self, physics: FetchPhysics) -> jax.Array:
        return physics.overflow

    def place(self, qpos: jax.Array, qvel: jax.Array) -> FetchPhysics:
        """Returns the physics with joint positions `[nq]` and velocities `[nv]`, without a history."""
        qpos, qvel = jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
        gripper = self._arm.pose(qpos, qvel)
        return FetchPhysics(
            steps=jnp.zeros((), jnp.int32),
            qpos=qpos,
            qvel=qvel,
            warmstart=jnp.zeros(self.model.nv),
            sensordata=jnp.zeros(self.model.nsensordata),
            overflow=jnp.zeros((), bool),
            body_position=gripper.body_position,
            body_quaternion=gripper.body_quaternion,
            gripper_position=gripper.site_position,
            gripper_velocity=gripper.site_velocity * CONTROL_PERIOD,
        )

    def engine_data(self, physics: FetchPhysics, displacement: jax.Array, grip: jax.Array | None = None) -> mjx.Data:
        """Returns what `mjx.step` is given, together with `engine_model`, to carry out an action.

        Args:
          physics: where from.
          displacement: `[3]` in [-1, 1], where the mocap body pulls the gripper.
          grip: `[]` in [-1, 1], metres by which the fingers' servos lead the fingers; None puts the fingers back to
            their closed position instead.

        """
        data = jax.tree.map(_as_constant, self._blank_data).replace(
            qpos=physics.qpos,
            qvel=physics.qvel,
            qacc_warmstart=physics.warmstart,
            mocap_pos=(physics.body_position + LEAD * displacement)[None],
            mocap_quat=(physics.body_quaternion + _DOWNWARD)[None],
        )
        return data if grip is None else data.replace(ctrl=physics.qpos[self._finger_qpos] + grip)

    def _run(self, data: mjx.Data) -> mjx.Data:
        """Takes `substeps` physics steps: a constant of the program, or a GPU would wait for the host each time."""
        return jax.lax.fori_loop(0, self.substeps, lambda _, data: _engine_step(self.engine_model, data), data)

    def _move(self, physics: FetchPhysics, displacement: jax.Array, grip: jax.Array | None = None) -> FetchPhysics:
        """Runs the physics for `CONTROL_PERIOD`; see `engine_data` for the arguments."""
        data = self._run(self.engine_data(physics, displacement, grip))
        qpos = data.qpos if grip is not None else data.qpos.at[self._finger_qpos].set(0.0)
        overflow = data._impl.overflow != 0 if self.impl == "warp" else False
        return self.place(qpos, data.qvel).replace(
            steps=physics.steps + 1,
            warmstart=data.qacc_warmstart,
            sensordata=data.sensordata,
            overflow=physics.overflow | overflow,
        )


def _as_constant(values: np.ndarray) -> jax.Array:
    """Returns values as part of a program: where all are equal as a broadcast, since buffers are many megabytes."""
    if values.size and (values == values.flat[0]).all():
        return jnp.full(values.shape, values.flat[0], values.dtype)
    return jnp.asarray(values)


def _make_blank_data(model: mujoco.MjModel, impl: str, sizes: dict[str, int]) -> mjx.Data:
    """Returns what a step starts from before anything is set, as NumPy arrays; `sizes` is from `buffer_sizes`.

    MJX-Warp leaves what it would note of islands, and a count of the Hessian's blocks, uninitialised. Zeros there make
    two processes compile the same program, so that the second finds it in the cache.
    """

    def initialised(path, values):
        name = jax.tree_util.keystr(path[-1:], simple=True)
        return np.zeros_like(values) if re.search("island|idof|iefc|jtdaj", name) else np.asarray(values)

    return jax.tree_util.tree_map_with_path(initialised, mjx.make_data(model, impl=impl, **sizes))


def resolve_impl(impl: str) -> str:
    """Returns the MJX implementation that `"auto"`, `"jax"` or `"warp"` stands for here.

    Raises:
      ValueError: `impl` is none of these, or is not available.

    """
    if impl not in ("auto", "jax", "warp"):
        raise ValueError(f"unknown impl {impl!r}; choose from auto, jax, warp")
    available = importlib.util.find_spec("warp") is not None and jax.default_backend() == "gpu"
    if impl == "warp" and not available:
        raise ValueError("impl 'warp' needs warp-lang and an NVIDIA GPU; use 'jax' or 'auto'")
    return "jax" if impl == "jax" or not available else "warp"


def buffer_sizes(model: mujoco.MjModel, worlds: int) -> dict[str, int]:
    """Returns the most contacts of all worlds together and the most constraint rows of one: `make_data`'s arguments.

    A plane and a box meet in at most four points, two boxes in eight. A contact takes two rows per direction of its
    friction pyramid, a weld six rows, a limited joint one for each limit. There is a quarter to spare: more rows than
    that have been asked for when a hand was pressed into the cube.
    """
    planes = model.geom_type[model.pair_geom1] == mujoco.mjtGeom.mjGEOM_PLANE
    points = np.where(planes, 4, 8)
    rows = 6 * model.neq + 2 * int(model.jnt_limited.sum()) + int(np.sum(points * 2 * (model.pair_dim - 1)))
    return {"naconmax": int(points.sum()) * worlds, "njmax": rows + rows // 4}


def settle(model: mujoco.MjModel, raise_start: float = 0.0) -> mujoco.MjData:
    """Brings the arm to its start, as the reference does: pull the gripper there with C MuJoCo and let it settle."""
    data = mujoco.MjData(model)
    for joint, position in _BASE_POSITION.items():
        data.joint(joint).qpos = position
    mujoco.mj_forward(model, data)
    data.mocap_pos[0] = data.site("grip").xpos + _GRIPPER_OFFSET + [0.0, 0.0, raise_start]
    data.mocap_quat[0] = _DOWNWARD
    mujoco.mj_step(model, data, nstep=_SETTLE_PERIODS * ACCURATE_SUBSTEPS)
    mujoco.mj_forward(model, data)
    return data

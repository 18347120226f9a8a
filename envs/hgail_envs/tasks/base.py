"""Base class of all tasks of an arm with a hand: its start, its end-effector control, and objects on a table."""

import copy
import functools
from typing import TypeVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from hgail_envs.base import GoalEnv
from hgail_envs.engines import Control, Engine, check_impl, jax_has_started, make_engine
from hgail_envs.engines.c import digest
from hgail_envs.randomization import OF_OBJECT
from hgail_envs.robots import make_robot
from hgail_envs.robots.base import BASE_X, CONTROL_PERIOD, REFERENCE_SUBSTEPS, START_HEIGHT, ArmPhysics
from hgail_envs.scenes import check_contacts, check_names, find_scene
from hgail_envs.tasks import layouts
from hgail_envs.tasks.model import SceneModel
from hgail_envs.validation import check_count
from hgail_envs.variation import ModelFactors, SensorErrors

FAST_SUBSTEPS = 4
"""Fewest physics steps per action, 4 of 10 ms: longer ones make the gripper's weld (20 ms) unstable."""

LEAST_DISTANCE = 0.1
"""Least distance in the plane between the starts of object and gripper, and of two objects, metres."""

_POSTURES = 64  # settled in advance for randomised starts; each takes C MuJoCo a few milliseconds
# A candidate is far enough with probability 0.65, or 0.21 for the puck of slide: all 64 fail once in 3 million draws.
_CANDIDATES = 64
_ROAM = 0.15  # metres around the gripper's start, in which its random goals are
_LOWEST = 0.42  # metres; the pads rest on the table at 0.417

PhysicsT = TypeVar("PhysicsT", bound=ArmPhysics)

_INITIAL_PHYSICS: dict[tuple, ArmPhysics] = {}  # by task: its program takes most of the time that making a task takes


class ArmEnv(GoalEnv):
    """A task of an arm with a hand, above a table.

    An action is four numbers in [-1, 1]: three end-effector displacements (x, y, z; a unit moves the gripper about
    33 mm once it is up to speed) and the gripper command. A task sets `scene` and the attributes of a `GoalEnv`; its
    arm may start elsewhere. The `robot` moves the gripper and knows the names in the model.

    The physics engine `impl` is `"auto"`, `"warp"`, `"c"` or `"jax"`, see `hgail_envs.engines.resolve_impl`. An action
    always lasts `CONTROL_PERIOD`, in physics steps from `FAST_SUBSTEPS` to `REFERENCE_SUBSTEPS`. At most `worlds`
    environments are stepped at once; MJX-Warp sizes its contact buffers by it. Other values are a ValueError.

    Making a task does not start JAX, which no process that is forked later could use. So the engine and the start are
    made at first use unless JAX has started, and an `impl` that is not available here is refused then.
    """

    scene: str
    episode_length = 50
    action_layout = layouts.ACTION
    control_period = CONTROL_PERIOD
    success_threshold = 0.05
    observation_limit = 10.0  # metres; the arm reaches hardly 2 m from the origin
    base_x: float = BASE_X
    """Position of the robot along x, metres."""
    start_height: float = START_HEIGHT
    """Nominal height of the gripper's start above the table, metres."""
    least_widest_gap: float = 0.0
    """Metres to which the hand must be able to open in this task, however wide the object is."""

    def __init__(
        self, impl: str = "auto", substeps: int = REFERENCE_SUBSTEPS, worlds: int = 4096, robot: str = "fetch"
    ) -> None:
        check_count("substeps", substeps, FAST_SUBSTEPS, REFERENCE_SUBSTEPS)
        check_count("worlds", worlds)
        of_reference = impl == "reference"
        if not of_reference:
            check_impl(impl)
        self.robot = make_robot(robot, find_scene(type(self)), self.base_x, self.start_height)
        self.model = self.robot.model
        self._check_scene()
        make_own = functools.partial(make_engine, impl, self.model, CONTROL_PERIOD, substeps, worlds)
        self._make_engine = self.robot.reference_engine if of_reference else make_own
        settled = self.robot.settle()
        self._scene_model = SceneModel(self.robot)
        # What the arm may have touched on its way, a drawer for instance, starts as the scene has it.
        parts = self._scene_model.of_parts_qpos, self._scene_model.of_parts_qvel
        self._start_qpos = np.where(parts[0], self.model.qpos0, settled.qpos)
        self._start_qvel = np.where(parts[1], 0.0, settled.qvel)
        self.initial_gripper_position = settled.site("grip").xpos.copy()
        self._settled: dict[float, ArmPhysics] = {}
        if jax_has_started():  # at once: later it would wait for a GPU that is loading kernels
            self.engine, self._initial_physics  # noqa: B018

    def _check_scene(self) -> None:
        """Raises a ValueError if the scene is not as the task needs it."""
        check_contacts(self.model, self.robot.scene)

    @functools.cached_property
    def not_randomized(self) -> tuple[str, ...]:  # type: ignore[override]
        """Sizes of a randomisation that are of free objects, in a scene that has parts on joints instead."""
        parts_alone = self._scene_model.of_parts_qpos.any() and not self._scene_model.has_object
        return OF_OBJECT if parts_alone else ()

    @functools.cached_property
    def engine(self) -> Engine:
        """The physics engine."""
        with jax.ensure_compile_time_eval():  # the first use may be traced
            return self._make_engine()

    @functools.cached_property
    def max_worlds(self) -> int | None:  # type: ignore[override]
        return self.engine.max_worlds

    @functools.cached_property
    def _initial_physics(self) -> ArmPhysics:
        # A scene's file may change between two tasks, as in a notebook.
        of_task = type(self), digest(self.model), self.base_x, self.start_height, jnp.result_type(float)
        if of_task not in _INITIAL_PHYSICS:
            with jax.ensure_compile_time_eval():
                placed = jax.jit(self.place)(self._start_qpos, self._start_qvel)
                _INITIAL_PHYSICS[of_task] = jax.device_get(placed)
        return _INITIAL_PHYSICS[of_task]

    @property
    def impl(self) -> str:
        return self.engine.name

    @property
    def substeps(self) -> int:
        return self.engine.substeps

    def prepare(self) -> None:
        self.engine.prepare()

    def reference_physics(self) -> "ArmEnv":
        """Returns the task with `REFERENCE_SUBSTEPS`."""
        env = copy.copy(self)
        env.engine = self.engine.with_substeps(REFERENCE_SUBSTEPS)
        return env

    def reset_physics(self, rng: jax.Array) -> ArmPhysics:
        del rng  # the arm always starts from the same pose
        return jax.tree.map(jnp.asarray, self._initial_physics)

    def random_position(self, rng: jax.Array) -> jax.Array:
        """Draws a goal position of the gripper, `[3]`: around its start, and not in the table."""
        offset = jax.random.uniform(rng, (3,), minval=-_ROAM, maxval=_ROAM)
        return (self.initial_gripper_position + offset).at[2].max(_LOWEST)

    def random_place(self, rng: jax.Array, width: float, *others: jax.Array) -> jax.Array:
        """Draws an object's start, `[2]`: up to `width` around the gripper's, away from it and from `others`, `[2]`."""
        # Rejection sampling in fixed time: the first of many candidates that is far enough.
        offsets = jax.random.uniform(rng, (_CANDIDATES, 2), minval=-width, maxval=width)
        places = self.initial_gripper_position[None, :2] + offsets
        far = jnp.linalg.norm(offsets, axis=-1) >= LEAST_DISTANCE
        for other in others:
            far &= jnp.linalg.norm(places - other[None], axis=-1) >= LEAST_DISTANCE
        return places[jnp.argmax(far)]

    def qpos_of(self, joint: str) -> slice:
        """Returns where a joint's position is in `qpos`: three numbers of a free one, else one."""
        return self._numbers_of(joint, "qposadr")

    def qvel_of(self, joint: str) -> slice:
        """Returns where a joint's velocity is in `qvel`: three numbers of a free one, else one."""
        return self._numbers_of(joint, "dofadr")

    def _numbers_of(self, joint: str, address: str) -> slice:
        size = 3 if self.is_free(joint) else 1
        first = int(getattr(self.model.joint(joint), address)[0])
        return slice(first, first + size)

    def is_free(self, joint: str) -> bool:
        """Returns whether a joint is free; a ValueError if the scene has none of this name."""
        check_names(self.model, self.robot.scene, "joint", joint)
        return bool(self.model.joint(joint).type[0] == mujoco.mjtJoint.mjJNT_FREE)

    def put_down(self, physics: PhysicsT, joint: str, position: jax.Array) -> PhysicsT:
        """Returns the physics with the body of a free joint at `position`, `[3]`, upright and at rest."""
        pose = jnp.concatenate([position, jnp.array([1.0, 0.0, 0.0, 0.0])])
        return physics.replace(
            qpos=jax.lax.dynamic_update_slice(physics.qpos, pose, (self.qpos_of(joint).start,)),
            qvel=jax.lax.dynamic_update_slice(physics.qvel, jnp.zeros(6), (self.qvel_of(joint).start,)),
        )

    def gap(self, physics: ArmPhysics) -> jax.Array:
        """Returns the distance between the fingers, `[]`, metres."""
        return self.robot.gap(physics.qpos)

    def widest_gap(self, physics: ArmPhysics) -> jax.Array | float:
        """Returns the widest distance between the fingers, `[]`, metres."""
        return self.robot.widest_gap(physics.factors)

    def object_factor(self, physics: ArmPhysics) -> jax.Array | float:
        """Returns the factor on the size of the objects, `[]`."""
        return 1.0 if physics.factors is None else physics.factors.object_size

    def overflow(self, physics: ArmPhysics) -> jax.Array:
        return physics.overflow

    def add_sensor_noise(self, physics: ArmPhysics, errors: SensorErrors) -> ArmPhysics:
        qpos, qvel = physics.qpos, physics.qvel
        if self._scene_model.has_object:
            qpos = qpos.at[self._scene_model.object_qpos].add(errors.object)
            # The physics state has metres per second, the errors and the gripper's velocity metres per action.
            qvel = qvel.at[self._scene_model.object_qvel].add(errors.object_motion / CONTROL_PERIOD)
        return physics.replace(
            qpos=qpos,
            qvel=qvel,
            gripper_position=physics.gripper_position + errors.robot,
            gripper_velocity=physics.gripper_velocity + errors.robot_motion,
        )

    def vary_model(self, physics: ArmPhysics, factors: ModelFactors) -> ArmPhysics:
        """Scales the model, with room for objects in a narrow hand, and sets them on the table; see `SceneModel`."""
        model = self._scene_model
        qpos = model.on_table(physics.qpos, factors.object_size)
        return physics.replace(qpos=qpos, factors=model.with_room(factors, self.least_widest_gap))

    def vary_start(self, rng: jax.Array, physics: PhysicsT, shift: float, opening: jax.Array | float) -> PhysicsT:
        """Draws a posture at least `LEAST_DISTANCE` from all objects, and opens a hand with servos; see `GoalEnv`."""
        drawn = jax.random.uniform(rng, (_POSTURES + 1,))  # one draw compiles the fastest
        scores, opened = drawn[1:], drawn[0]
        postures, model = self._postures(shift), self._scene_model
        if model.has_object:
            away = postures.gripper_position[:, None, :2] - physics.qpos[model.object_qpos[:, :2]][None]
            far = (jnp.linalg.norm(away, axis=-1) >= LEAST_DISTANCE).all(axis=1)
            # Scores are below 1, so that each posture that is far enough is ahead of each that is not.
            scores = scores + far.astype(scores.dtype)
        chosen = jnp.argmax(scores)
        qpos = jnp.where(model.of_arm_qpos, postures.qpos[chosen], physics.qpos)
        qvel = jnp.where(model.of_arm_qvel, postures.qvel[chosen], physics.qvel)
        qpos = self.robot.opened(qpos, self.widest_gap(physics) * opening * opened)
        return self._with_gripper(physics.replace(qpos=qpos, qvel=qvel))

    def _postures(self, shift: float) -> ArmPhysics:
        """Returns the arm settled at random places around its start, leaves `[_POSTURES, ...]`, the same each time."""
        # C MuJoCo cannot settle the arm within a program, so the places do not depend on the episode's key.
        if shift not in self._settled:
            offsets = np.random.default_rng(0).uniform(-shift, shift, (_POSTURES, 3))
            lowest = _LOWEST - self.initial_gripper_position[2]
            offsets[:, 2] = np.maximum(offsets[:, 2], min(lowest, 0.0))
            ends = [self.robot.settle(offset) for offset in offsets]
            qpos, qvel = (np.stack([getattr(end, name) for end in ends]) for name in ("qpos", "qvel"))
            with jax.ensure_compile_time_eval():  # the first call may be traced, and must keep no tracers
                placed = jax.vmap(self.place)(jnp.asarray(qpos), jnp.asarray(qvel))
                self._settled[shift] = jax.tree.map(np.asarray, placed)
        return jax.tree.map(jnp.asarray, self._settled[shift])

    def place(self, qpos: jax.Array, qvel: jax.Array) -> ArmPhysics:
        """Returns the physics with joint positions `[nq]` and velocities `[nv]`, before any step."""
        return self._with_gripper(
            ArmPhysics(
                qpos=jnp.asarray(qpos, jnp.float32),
                qvel=jnp.asarray(qvel, jnp.float32),
                warmstart=jnp.zeros(self.model.nv),
                sensordata=jnp.zeros(self.model.nsensordata),
                overflow=jnp.zeros((), bool),
                body_position=jnp.zeros(3),
                body_quaternion=jnp.zeros(4),
                gripper_position=jnp.zeros(3),
                gripper_velocity=jnp.zeros(3),
            )
        )

    def control(self, physics: ArmPhysics, displacement: jax.Array, grip: jax.Array | None = None) -> Control:
        """Returns the engine's control for an action in `physics`; see `Robot` for the arguments."""
        control = self.robot.control(physics, displacement, grip)
        return control if physics.factors is None else control.replace(model=self._scene_model.fields(physics.factors))

    def _move(self, physics: PhysicsT, displacement: jax.Array, grip: jax.Array | None = None) -> PhysicsT:
        """Carries out an action; see `control` for the arguments."""
        moved = self.engine.step(physics, self.control(physics, displacement, grip))
        if grip is None:
            moved = moved.replace(qpos=self.robot.keep_closed(moved.qpos))
        return self._with_gripper(moved)

    def _with_gripper(self, physics: PhysicsT) -> PhysicsT:
        """Returns the physics with the gripper's pose and velocity, by forward kinematics."""
        gripper = self.robot.gripper(physics.qpos, physics.qvel)
        return physics.replace(
            body_position=gripper.body_position,
            body_quaternion=gripper.body_quaternion,
            gripper_position=gripper.site_position,
            gripper_velocity=gripper.site_velocity * CONTROL_PERIOD,
        )

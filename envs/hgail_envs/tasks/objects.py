"""Base class of push, pick and place and slide: an object is brought to a place."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax import math
from flax import struct

from hgail_envs.base import EpisodeMetrics, State
from hgail_envs.layout import Layout, flag
from hgail_envs.tasks.base import CONTROL_PERIOD, ArmEnv, ArmPhysics
from hgail_envs.tasks.layouts import TARGET, gripper_values, official, target_of
from hgail_envs.validation import check_name
from hgail_envs.variation import ModelFactors

OBSERVATIONS = ("compact", "official")
"""Values of `observation`."""
OF_OBJECT = "target is the object's, not the gripper's"
"""Name of the flag in a goal."""
GOAL = Layout(TARGET, flag(OF_OBJECT))
MOVED = 0.01
"""Metres from its start, beyond which an object's position may be the achieved goal."""
AT_GOAL = 0.03
"""Metres between object and goal, within which the goal is already solved."""

_GRIPPER, _OBJECT = 0.0, 1.0  # fourth number of a goal: its position is the gripper's or the object's
_IN_THE_AIR = 0.45  # metres of height; on the table a cube's centre is at 0.425
_BELOW_THE_TABLE = 0.35  # metres of height, of an object that fell

_ROAMING = 0.5  # fraction of the training episodes whose goals are waypoints
_EVERY = 12  # steps from one waypoint to the next: a hand at full speed moves 0.4 m
_LEAST_OFFSET, _MOST_OFFSET = (-0.12, -0.12, -0.01), (0.12, 0.12, 0.05)  # metres from the object to a waypoint


class ObjectPhysics(ArmPhysics, kw_only=True):
    """`ArmPhysics` and the object's start."""

    object_start: jax.Array
    """`[3]`: metres."""


class WaypointPlan(struct.PyTreeNode):
    """The goals of an episode."""

    goal: jax.Array
    """`[goal_size]`: the object's goal."""
    roams: jax.Array
    """`[]` boolean: whether the goals are waypoints of the gripper instead."""
    offsets: jax.Array
    """`[waypoints, 3]`: from the object to each waypoint, metres."""


class ObjectEnv(ArmEnv):
    """A Fetch task in which an object is brought to a place.

    A goal is a position and a flag: 0 for the gripper's position, 1 for the object's. The achieved goal of a state is
    the object's position, with 1, once the object is more than 1 cm from its start; until then it is the gripper's
    position, with 0. So hindsight first teaches to move the hand, and then to move the object.

    Evaluation episodes have the reference's goals, with 1. A goal is reached within 5 cm, by the object's position
    alone: one that starts at its target is a success, though its position is not yet an achieved goal. An episode's
    success is that of its last step. Distances are between object and goal.

    In half the training episodes the goals are waypoints of the gripper near the object, another one every 12 steps,
    unless a task overrides `plan_goals` and `current_goal`.

    Kinds of goals, see `goal_kind`: the gripper's, the object's on the table, the object's elsewhere.

    A task sets `object_name`, `object_title`, `object_range`, `target_range` and `target_offset`, the scene, and
    `features_layout`, which begins with the gripper's quantities and the object's. The `observation` is `"compact"`, or
    `"official"` for the reference's 25 numbers, see `hgail_envs.tasks.layouts.official`; with these the task has no
    controllers. See `ArmEnv` for the other arguments.
    """

    goal_layout = GOAL
    goal_kinds = 3

    object_name: str
    """Name of the object's free joint."""
    object_title: str
    """Name of the object in `features_layout`."""
    object_range: float
    """Metres around the gripper's start, along x and y, in which the object starts."""
    target_range: float
    """Metres around the middle of the targets, along x and y, in which they are."""
    target_offset: float = 0.0
    """Metres along x from the gripper's start to the middle of the targets."""

    def __init__(self, *args: Any, observation: str = OBSERVATIONS[0], **kwargs: Any) -> None:
        self.observation = observation
        self.features_layout = self.features_with(observation=observation)
        self.feature_size = self.features_layout.size
        if observation == "official":
            self.controllers = {}  # type: ignore[misc]  # they read the compact numbers
        super().__init__(*args, **kwargs)

    def _check_scene(self) -> None:
        super()._check_scene()
        if not self.is_free(self.object_name):
            raise ValueError(
                f"{type(self).__name__}.object_name is {self.object_name!r}, a slide or a hinge, which is for a"
                " JointEnv; an ObjectEnv's object has a free joint"
            )

    @functools.cached_property
    def object_height(self) -> float:
        """Height of the object's centre at the start, metres."""
        return float(np.float32(self._start_qpos[self.qpos_of(self.object_name)][2]))

    @classmethod
    def features_with(cls, **options: Any) -> Layout:
        observation = options.get("observation", OBSERVATIONS[0])
        check_name("observation", observation, OBSERVATIONS)
        return official(cls.object_title) if observation == "official" else cls.features_layout

    def place(self, qpos: jax.Array, qvel: jax.Array) -> ObjectPhysics:
        start = jnp.asarray(qpos[self.qpos_of(self.object_name)], jnp.float32)
        return ObjectPhysics(**vars(super().place(qpos, qvel)), object_start=start)

    def object_position(self, physics: ObjectPhysics) -> jax.Array:
        """Returns the object's centre, `[3]`, metres, world frame."""
        return physics.qpos[self.qpos_of(self.object_name)]

    def reset_physics(self, rng: jax.Array) -> ObjectPhysics:
        start = jnp.append(self.random_place(rng, self.object_range), self.object_height)
        physics: Any = super().reset_physics(rng)  # the arm's, which draws nothing: the key is used once
        return physics.replace(qpos=physics.qpos.at[self.qpos_of(self.object_name)].set(start), object_start=start)

    def vary_model(self, physics: Any, factors: ModelFactors) -> Any:
        varied: Any = super().vary_model(physics, factors)
        # An object of another height starts at another height, and that must not count as a movement.
        return varied.replace(object_start=self.object_position(varied))

    def step_physics(self, physics: ObjectPhysics, action: jax.Array) -> ObjectPhysics:
        return self._move(physics, action[:3])

    def features(self, physics: ObjectPhysics) -> jax.Array:
        see = self.official_features if self.observation == "official" else self.compact_features
        return self.features_layout.join(see(physics))

    def compact_features(self, physics: ObjectPhysics) -> dict[str, jax.Array]:
        """Returns the values of the default quantities by name."""
        position = self.object_position(physics)
        return gripper_values(physics) | {
            f"{self.object_title} position less gripper position": position - physics.gripper_position,
            f"{self.object_title} position": position,
            f"{self.object_title} velocity": self._object_velocity(physics),
        }

    def _object_velocity(self, physics: ObjectPhysics) -> jax.Array:
        return physics.qvel[self.qvel_of(self.object_name)] * CONTROL_PERIOD  # metres per action, as the gripper's

    def official_features(self, physics: ObjectPhysics) -> dict[str, jax.Array]:
        """Returns the values of the quantities of `hgail_envs.tasks.layouts.official` by name."""
        name = self.object_title
        quaternion = physics.qpos[self.qpos_of(self.object_name).stop :][:4]
        spin = physics.qvel[self.qvel_of(self.object_name).stop :][:3]  # in the object's frame
        with jax.default_matmul_precision("highest"):  # by default GPUs round to ten bits
            turning, angles = math.rotate(spin, quaternion) * CONTROL_PERIOD, _euler_angles(quaternion)
        opened, opening = self.robot.fingers(physics)
        fingers = {
            f"{what} of the {side} finger": values[index]
            for what, values in (("position", opened), ("velocity", opening * CONTROL_PERIOD))
            for index, side in enumerate(("right", "left"))
        }
        position = self.object_position(physics)
        seen = {
            f"{name} position": position,
            f"{name} position less gripper position": position - physics.gripper_position,
            f"{name} rotation, Euler angle": angles,
            f"{name} velocity less gripper velocity": self._object_velocity(physics) - physics.gripper_velocity,
            f"{name} angular velocity": turning,
        }
        return gripper_values(physics) | seen | fingers

    def achieved_goal(self, physics: ObjectPhysics) -> jax.Array:
        thing = self.object_position(physics)
        moved = jnp.linalg.norm(thing - physics.object_start) > MOVED
        return jnp.where(moved, object_goal(thing), gripper_goal(physics.gripper_position))

    def sample_goal(self, rng: jax.Array, physics: ObjectPhysics) -> jax.Array:
        offset = jax.random.uniform(rng, (2,), minval=-self.target_range, maxval=self.target_range)
        middle = self.initial_gripper_position[:2] + jnp.array([self.target_offset, 0.0])
        return object_goal(jnp.append(middle + offset, self.object_height))

    def plan_goals(self, rng: jax.Array, physics: ObjectPhysics, training_goals: jax.Array | bool) -> Any:
        kind_rng, goal_rng, offset_rng = jax.random.split(rng, 3)
        least, most = jnp.array(_LEAST_OFFSET), jnp.array(_MOST_OFFSET)
        waypoints = -(-self.episode_length // _EVERY)  # rounded up: the last may be cut short
        return WaypointPlan(
            goal=self.sample_goal(goal_rng, physics),
            roams=training_goals & jax.random.bernoulli(kind_rng, _ROAMING),
            offsets=jax.random.uniform(offset_rng, (waypoints, 3), minval=least, maxval=most),
        )

    def current_goal(self, plan: Any, physics: Any, step: jax.Array | int) -> jax.Array:
        # A waypoint follows the object, so that the hand stays near one that it has pushed away.
        waypoint = self.object_position(physics) + plan.offsets[step // _EVERY]
        return jnp.where(plan.roams, gripper_goal(waypoint), plan.goal)

    def aim(self, plan: Any, position: jax.Array) -> Any:
        """Sets the field `goal` that the plans of these tasks have; see `GoalEnv`."""
        return plan.replace(goal=plan.goal.at[: TARGET.size].set(position))

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        height = target_of(goal)[..., 2]
        elsewhere = (height > _IN_THE_AIR) | (height < _BELOW_THE_TABLE)
        return jnp.where(is_object(goal), 1 + elsewhere.astype(jnp.int32), 0)

    def goal_test(self, features: jax.Array, achieved: jax.Array, goal: jax.Array) -> jax.Array:
        """Tests the position alone, whether the object has moved or not; see `GoalEnv`."""
        gripper = features[..., self.features_layout["gripper position"]]
        position = jnp.where(is_object(goal)[..., None], self._object_in(features), gripper)
        return jnp.linalg.norm(position - target_of(goal), axis=-1) <= self.success_threshold

    def already_solved(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns whether goals are the object's and within 3 cm of its present position; see `GoalEnv`."""
        distance = jnp.linalg.norm(self._object_in(features) - target_of(goal), axis=-1)
        return is_object(goal) & (distance <= AT_GOAL)

    def _object_in(self, features: jax.Array) -> jax.Array:
        """Returns the object's position, `[..., 3]`, of features `[..., feature_size]`."""
        return features[..., self.features_layout[f"{self.object_title} position"]]

    def outcome(self, end: State, lifted: State) -> EpisodeMetrics:
        physics, desired = end.pipeline_state, end.info["desired_goal"]
        return self.measure(self.object_position(physics), target_of(desired), self.reached(physics, desired))


def gripper_goal(position: jax.Array) -> jax.Array:
    """Returns the goal that the gripper is at a position, `[..., 3]`: `[..., 4]`."""
    return jnp.append(position, _GRIPPER)


def object_goal(position: jax.Array) -> jax.Array:
    """Returns the goal that the object is at a position, `[..., 3]`: `[..., 4]`."""
    return jnp.append(position, _OBJECT)


def is_object(goal: jax.Array) -> jax.Array:
    """Returns whether goals are the object's, not the gripper's: booleans `[...]`."""
    return goal[..., GOAL[OF_OBJECT]] > 0.5


def _euler_angles(quaternion: jax.Array) -> jax.Array:
    """Converts a unit quaternion, `[4]`, to Euler angles, `[3]`, in the reference's convention."""
    matrix = math.quat_to_3x3(quaternion)
    # Signs and order of `mat2euler` in gymnasium_robotics.utils.rotations, without its branch for a gimbal lock.
    return jnp.array(
        [
            -jnp.arctan2(matrix[1, 2], matrix[2, 2]),
            jnp.arctan2(matrix[0, 2], jnp.hypot(matrix[2, 2], matrix[1, 2])),
            -jnp.arctan2(matrix[0, 1], matrix[0, 0]),
        ]
    )

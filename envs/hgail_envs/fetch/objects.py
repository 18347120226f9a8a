"""Base class of push, pick and place and slide: an object is brought to a place."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax import math

from hgail_envs.base import EpisodeMetrics, State
from hgail_envs.fetch.arm import CONTROL_PERIOD, REFERENCE_SUBSTEPS, FetchEnv, FetchPhysics
from hgail_envs.validation import check_name
from hgail_envs.variation import ModelFactors

OBSERVATIONS = ("compact", "official")
"""Values of `observation`."""
OFFICIAL_SIZE = 25
"""Numbers in the observation of the reference's tasks with an object."""

_GRIPPER, _OBJECT = 0.0, 1.0  # fourth number of a goal: its position is the gripper's or the object's
_MOVED = 0.01  # metres from its start, beyond which the object's position is the achieved goal
_AT_GOAL = 0.03  # metres between object and goal, within which the goal is already solved
_IN_THE_AIR = 0.45  # metres of height; on the table a cube's centre is at 0.425
_BELOW_THE_TABLE = 0.35  # metres of height, of an object that fell


class ObjectPhysics(FetchPhysics, kw_only=True):
    """`FetchPhysics` and the object's start."""

    object_start: jax.Array
    """`[3]`: metres."""


class ObjectEnv(FetchEnv):
    """A Fetch task in which an object is brought to a place.

    A goal is a position and a flag: 0 for the gripper's position, 1 for the object's. The achieved goal of a state is
    the object's position, with 1, once the object is more than 1 cm from its start; until then it is the gripper's
    position, with 0. So hindsight first teaches to move the hand, and then to move the object.

    Evaluation episodes have the reference's goals, with 1. Their reward, success and `reached` depend on the object's
    position alone, moved or not: an object that starts at its target is a success, though its position is not yet an
    achieved goal. So does `goal_test`, which reads the position from the features. Distances are between object and
    goal.

    Kinds of goals, see `goal_kind`: the gripper's, the object's on the table, the object's elsewhere.

    A task sets `object_name`, `object_range`, `target_range` and `target_offset`, and the scene. See `FetchEnv` for the
    other arguments.

    Args:
      observation: `"compact"`, or `"official"` for the reference's 25 numbers, see `official_features`; with these
        the task has no controllers.

    """

    feature_size = 15
    goal_size = 4
    goal_kinds = 3

    object_name: str
    """Name of the object's free joint."""
    object_range: float
    """Metres around the gripper's start, along x and y, in which the object starts."""
    target_range: float
    """Metres around the middle of the targets, along x and y, in which they are."""
    target_offset: float = 0.0
    """Metres along x from the gripper's start to the middle of the targets."""

    def __init__(
        self,
        impl: str = "auto",
        substeps: int = REFERENCE_SUBSTEPS,
        worlds: int = 4096,
        observation: str = OBSERVATIONS[0],
    ) -> None:
        check_name("observation", observation, OBSERVATIONS)
        self.observation = observation
        if observation == "official":
            self.feature_size = OFFICIAL_SIZE
            self.controllers = {}  # type: ignore[misc]  # they read the compact numbers
        super().__init__(impl, substeps, worlds)
        self.object_height = float(np.float32(self._start_qpos[self._object_qpos][2]))

    def place(self, qpos: jax.Array, qvel: jax.Array) -> ObjectPhysics:
        start = jnp.asarray(qpos[self._object_qpos], jnp.float32)
        return ObjectPhysics(**vars(super().place(qpos, qvel)), object_start=start)

    @property
    def _object_qpos(self) -> slice:
        first = int(self.model.joint(self.object_name).qposadr[0])
        return slice(first, first + 3)

    @property
    def _object_qvel(self) -> slice:
        first = int(self.model.joint(self.object_name).dofadr[0])
        return slice(first, first + 3)

    def object_position(self, physics: ObjectPhysics) -> jax.Array:
        """Returns the object's centre, `[3]`, metres, world frame."""
        return physics.qpos[self._object_qpos]

    def reset_physics(self, rng: jax.Array) -> ObjectPhysics:
        start = jnp.append(self.random_place(rng, self.object_range), self.object_height)
        physics: Any = super().reset_physics(rng)  # the arm's, which draws nothing: the key is used once
        return physics.replace(qpos=physics.qpos.at[self._object_qpos].set(start), object_start=start)

    def vary_model(self, physics: Any, factors: ModelFactors) -> Any:
        varied: Any = super().vary_model(physics, factors)
        # An object of another height starts at another height, and that must not count as a movement.
        return varied.replace(object_start=self.object_position(varied))

    def step_physics(self, physics: ObjectPhysics, action: jax.Array) -> ObjectPhysics:
        return self._move(physics, action[:3])

    def features(self, physics: ObjectPhysics) -> jax.Array:
        return self.official_features(physics) if self.observation == "official" else self.compact_features(physics)

    def compact_features(self, physics: ObjectPhysics) -> jax.Array:
        """Returns the default observation without the goal, `[15]` or more."""
        gripper, thing = physics.gripper_position, self.object_position(physics)
        velocity = physics.qvel[self._object_qvel] * CONTROL_PERIOD  # metres per action, as the gripper's
        return jnp.concatenate([gripper, physics.gripper_velocity, thing - gripper, thing, velocity])

    def official_features(self, physics: ObjectPhysics) -> jax.Array:
        """Returns the observation without the goal of Gymnasium-Robotics' tasks with an object, `[25]`.

        | index | quantity | unit |
        |---|---|---|
        | 0:3 | gripper position | m |
        | 3:6 | object position | m |
        | 6:9 | object position less gripper position | m |
        | 9:11 | positions of the right and the left finger | m |
        | 11:14 | object rotation, Euler angles | rad |
        | 14:17 | object velocity less gripper velocity, × 0.04 s | m |
        | 17:20 | object angular velocity, world frame, × 0.04 s | rad |
        | 20:23 | gripper velocity × 0.04 s | m |
        | 23:25 | velocities of the right and the left finger × 0.04 s | m |
        """
        gripper, thing = physics.gripper_position, self.object_position(physics)
        joint = self.model.joint(self.object_name)
        quaternion = physics.qpos[int(joint.qposadr[0]) + 3 :][:4]
        velocity = physics.qvel[self._object_qvel] * CONTROL_PERIOD
        spin = physics.qvel[int(joint.dofadr[0]) + 3 :][:3]  # in the object's frame
        with jax.default_matmul_precision("highest"):  # by default GPUs round to ten bits
            turning, angles = math.rotate(spin, quaternion) * CONTROL_PERIOD, _euler_angles(quaternion)
        return jnp.concatenate(
            [
                gripper,
                thing,
                thing - gripper,
                physics.qpos[self._finger_qpos],
                angles,
                velocity - physics.gripper_velocity,
                turning,
                physics.gripper_velocity,
                physics.qvel[self._finger_qvel] * CONTROL_PERIOD,
            ]
        )

    def achieved_goal(self, physics: ObjectPhysics) -> jax.Array:
        thing = self.object_position(physics)
        moved = jnp.linalg.norm(thing - physics.object_start) > _MOVED
        return jnp.where(moved, object_goal(thing), gripper_goal(physics.gripper_position))

    def sample_goal(self, rng: jax.Array, physics: ObjectPhysics) -> jax.Array:
        offset = jax.random.uniform(rng, (2,), minval=-self.target_range, maxval=self.target_range)
        middle = self.initial_gripper_position[:2] + jnp.array([self.target_offset, 0.0])
        return object_goal(jnp.append(middle + offset, self.object_height))

    def aim(self, plan: Any, position: jax.Array) -> Any:
        """Sets the field `goal` that the plans of these tasks have; see `GoalEnv`."""
        return plan.replace(goal=plan.goal.at[:3].set(position))

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        height = goal[..., 2]
        elsewhere = (height > _IN_THE_AIR) | (height < _BELOW_THE_TABLE)
        return jnp.where(_is_object(goal), 1 + elsewhere.astype(jnp.int32), 0)

    def success(self, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        return super().success(achieved[..., :3], desired[..., :3]) & (achieved[..., 3] == desired[..., 3])

    def reached(self, physics: ObjectPhysics, desired: jax.Array) -> jax.Array:
        position = jnp.where(_is_object(desired), self.object_position(physics), physics.gripper_position)
        return super().success(position, desired[:3])

    def goal_test(self, features: jax.Array, achieved: jax.Array, goal: jax.Array) -> jax.Array:
        """Tests the position alone, as `reached` does, whether the object has moved or not; see `GoalEnv`."""
        position = jnp.where(_is_object(goal)[..., None], self._object_in(features), features[..., :3])
        return super().success(position, goal[..., :3])

    def already_solved(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns whether goals are the object's and within 3 cm of its present position; see `GoalEnv`."""
        distance = jnp.linalg.norm(self._object_in(features) - goal[..., :3], axis=-1)
        return _is_object(goal) & (distance <= _AT_GOAL)

    def _object_in(self, features: jax.Array) -> jax.Array:
        """Returns the object's position, `[..., 3]`, of features `[..., feature_size]`."""
        return features[..., 3:6] if self.observation == "official" else features[..., 9:12]

    def outcome(self, end: State, lifted: State) -> EpisodeMetrics:
        physics, desired = end.pipeline_state, end.info["desired_goal"]
        reached = self.reached(physics, desired).astype(jnp.float32)
        distances = self.measure(self.object_position(physics), desired[:3])
        return distances.replace(success=reached, achieved=reached)


def gripper_goal(position: jax.Array) -> jax.Array:
    """Returns the goal that the gripper is at a position, `[..., 3]`: `[..., 4]`."""
    return jnp.append(position, _GRIPPER)


def object_goal(position: jax.Array) -> jax.Array:
    """Returns the goal that the object is at a position, `[..., 3]`: `[..., 4]`."""
    return jnp.append(position, _OBJECT)


def _is_object(goal: jax.Array) -> jax.Array:
    return goal[..., 3] > 0.5


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

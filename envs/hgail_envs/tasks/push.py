"""FetchPush: push a cube to a place on the table."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from hgail_envs.tasks import controllers
from hgail_envs.tasks.layouts import ACTION_OF_ARM, GRIPPER, of_object
from hgail_envs.tasks.objects import GOAL, ObjectEnv, ObjectPhysics, gripper_goal

_ROAMING = 0.5  # fraction of the training episodes whose goals are waypoints
_EVERY = 12  # steps from one waypoint to the next: a hand at full speed moves 0.4 m
_LEAST_OFFSET, _MOST_OFFSET = (-0.12, -0.12, -0.01), (0.12, 0.12, 0.05)  # metres from the object to a waypoint


class PushPlan(struct.PyTreeNode):
    """The goals of an episode of `Push`."""

    goal: jax.Array
    """`[goal_size]`: the object's goal."""
    roams: jax.Array
    """`[]` boolean: whether the goals are waypoints of the gripper instead."""
    offsets: jax.Array
    """`[waypoints, 3]`: from the object to each waypoint, metres."""


class Push(ObjectEnv):
    """FetchPush: push a cube to a place on the table, with closed fingers.

    The start is the reference's, see `docs/tasks.md`; unlike there, the table has no edge from which the cube could
    fall.

    In half the training episodes the goals are waypoints of the gripper near the cube, another one every 12 steps. TD3
    needs them (`docs/lab/off-policy.md`), PPO only in `Slide`, which inherits them (`docs/lab/ppo.md`).

    See `ObjectEnv` for the meaning of a goal, success and the arguments.
    """

    features_layout, goal_layout = GRIPPER + of_object("cube"), GOAL
    action_layout = ACTION_OF_ARM

    start_height = 0.0
    object_name = object_title = "cube"
    object_range = 0.15
    target_range = 0.15

    scene = "push"
    reference = "FetchPush-v4"
    controllers = (features_layout + goal_layout).readers({"from-behind": controllers.push})

    def plan_goals(self, rng: jax.Array, physics: ObjectPhysics, training_goals: jax.Array | bool) -> PushPlan:
        kind_rng, goal_rng, offset_rng = jax.random.split(rng, 3)
        least, most = jnp.array(_LEAST_OFFSET), jnp.array(_MOST_OFFSET)
        waypoints = -(-self.episode_length // _EVERY)  # rounded up: the last may be cut short
        return PushPlan(
            goal=self.sample_goal(goal_rng, physics),
            roams=training_goals & jax.random.bernoulli(kind_rng, _ROAMING),
            offsets=jax.random.uniform(offset_rng, (waypoints, 3), minval=least, maxval=most),
        )

    def current_goal(self, plan: Any, physics: ObjectPhysics, step: jax.Array | int) -> jax.Array:
        # A waypoint follows the object, so that the hand stays near one that it has pushed away.
        waypoint = self.object_position(physics) + plan.offsets[step // _EVERY]
        return jnp.where(plan.roams, gripper_goal(waypoint), plan.goal)

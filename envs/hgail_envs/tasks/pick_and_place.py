"""FetchPickAndPlace: bring a cube to a place on the table or in the air."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from hgail_envs.tasks import controllers
from hgail_envs.tasks.grasp import holds
from hgail_envs.tasks.layouts import GRIPPER, HAND, of_object
from hgail_envs.tasks.objects import GOAL, ObjectEnv, ObjectPhysics, gripper_goal

AT_CUBE = 0.04
"""Metres between gripper and cube, within which a relay's goal becomes the cube's."""
HIGHEST = 0.45
"""Largest height of a goal in the air above the goals on the table, metres."""

_RELAYS, _ELSEWHERE = 0.5, 0.125  # fractions of the training episodes
_PADS = 2  # whose touch of the cube the scene's first sensors measure


class PickAndPlacePlan(struct.PyTreeNode):
    """The goals of an episode of `PickAndPlace` or `hgail_envs.tasks.stack.Stack`."""

    goal: jax.Array
    """`[goal_size]`."""
    relay: jax.Array
    """`[]` boolean: whether the goals are the stages on the way to it, first the gripper at the cube."""


def draw_kind(rng: jax.Array, training_goals: jax.Array | bool) -> tuple[jax.Array, jax.Array]:
    """Draws whether training goals are the stages on the way, or a random place: booleans `[]`, one True at most."""
    kind = jnp.where(training_goals, jax.random.uniform(rng), 1.0)
    return kind < _RELAYS, (kind >= _RELAYS) & (kind < _RELAYS + _ELSEWHERE)


class PickAndPlace(ObjectEnv):
    """FetchPickAndPlace: grasp a cube and bring it to a place, in half the episodes up to 45 cm above the table.

    Start, goals and the relays of training are in `docs/tasks.md`; a random policy hardly ever moves the cube. See
    `ObjectEnv` for the meaning of a goal, success and the arguments.
    """

    features_layout, goal_layout = GRIPPER + of_object("cube") + HAND, GOAL
    object_name = object_title = "cube"
    holding_title = "hand holds the cube"
    """Name of the flag in `features_layout`."""
    object_range = 0.15
    target_range = 0.15

    scene = "grasp"
    instruction = "Grasp the cube and bring it to the target."
    reference: str | None = "FetchPickAndPlace-v4"
    controllers = (features_layout + goal_layout).readers({"from-above": controllers.pick_and_place})

    def holding(self, physics: ObjectPhysics) -> jax.Array:
        """Returns whether the hand holds the cube, see `hgail_envs.tasks.grasp.is_held`: a boolean `[]`."""
        return holds(self, physics, jnp.all(physics.sensordata[:_PADS] > 0))

    def step_physics(self, physics: ObjectPhysics, action: jax.Array) -> ObjectPhysics:
        return self._move(physics, action[:3], action[3])

    def compact_features(self, physics: ObjectPhysics) -> dict[str, jax.Array]:
        hand = {"gap between the fingers": self.gap(physics), self.holding_title: self.holding(physics)}
        return super().compact_features(physics) | hand

    def sample_goal(self, rng: jax.Array, physics: ObjectPhysics) -> jax.Array:
        place_rng, air_rng, height_rng = jax.random.split(rng, 3)
        height = jax.random.uniform(height_rng, maxval=HIGHEST)
        return super().sample_goal(place_rng, physics).at[2].add(jnp.where(jax.random.bernoulli(air_rng), height, 0.0))

    def plan_goals(self, rng: jax.Array, physics: ObjectPhysics, training_goals: jax.Array | bool) -> PickAndPlacePlan:
        kind_rng, position_rng, goal_rng = jax.random.split(rng, 3)
        relay, elsewhere = draw_kind(kind_rng, training_goals)
        anywhere, goal = gripper_goal(self.random_position(position_rng)), self.sample_goal(goal_rng, physics)
        return PickAndPlacePlan(goal=jnp.where(elsewhere, anywhere, goal), relay=relay)

    def current_goal(self, plan: Any, physics: ObjectPhysics, step: jax.Array | int) -> jax.Array:
        # By the state alone: a relay whose cube slips out of the hand sends the gripper back to it.
        cube = self.object_position(physics)
        away = jnp.linalg.norm(physics.gripper_position - cube) > AT_CUBE
        return jnp.where(plan.relay & away, gripper_goal(cube), plan.goal)

"""FetchReach: bring the gripper to a point in the air."""

import jax

from hgail_envs.layout import Layout
from hgail_envs.tasks import controllers
from hgail_envs.tasks.base import ArmEnv, ArmPhysics
from hgail_envs.tasks.layouts import ACTION_OF_ARM, GRIPPER, TARGET, gripper_values

GOAL_RANGE = 0.15
"""Largest distance of a goal from the gripper's start along each axis, metres."""


class Reach(ArmEnv):
    """FetchReach with the paper's observation, nine numbers: the gripper's position and velocity, and the target.

    The fingers are blocked, so the action's fourth number has no effect. Goals are uniform in a cube of ±0.15 m
    around the gripper's start. The reference is Gymnasium-Robotics' FetchReach-v4.
    """

    features_layout = GRIPPER
    goal_layout = Layout(TARGET)
    action_layout = ACTION_OF_ARM

    scene = "reach"
    instruction = "Move the gripper to the target."
    reference = "FetchReach-v4"
    controllers = (features_layout + goal_layout).readers({"proportional": controllers.reach})

    def step_physics(self, physics: ArmPhysics, action: jax.Array) -> ArmPhysics:
        return self._move(physics, action[:3])  # the fingers are blocked

    def features(self, physics: ArmPhysics) -> jax.Array:
        return self.features_layout.join(gripper_values(physics))

    def achieved_goal(self, physics: ArmPhysics) -> jax.Array:
        return physics.gripper_position

    def sample_goal(self, rng: jax.Array, physics: ArmPhysics) -> jax.Array:
        offset = jax.random.uniform(rng, (3,), minval=-GOAL_RANGE, maxval=GOAL_RANGE)
        return self.initial_gripper_position + offset

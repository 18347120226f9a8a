"""FetchReach: bring the gripper to a point in the air."""

from collections.abc import Mapping
from typing import ClassVar

import jax
import jax.numpy as jnp

from hgail_envs.base import Controller
from hgail_envs.fetch import controllers
from hgail_envs.fetch.arm import FetchEnv, FetchPhysics

GOAL_RANGE = 0.15
"""Largest distance of a goal from the gripper's start along each axis, metres."""


class Reach(FetchEnv):
    """FetchReach with the paper's observation, nine numbers.

    | index | quantity | unit |
    |---|---|---|
    | 0:3 | gripper position | m |
    | 3:6 | gripper velocity × 0.04 s | m |
    | 6:9 | target position, the goal | m |

    The fingers are blocked, so the action's fourth number has no effect. Goals are uniform in a cube of ±0.15 m
    around the gripper's start. The reference is Gymnasium-Robotics' FetchReach-v4.
    """

    feature_size = 6
    goal_size = 3

    scene = "fetch/reach"
    reference = "FetchReach-v4"
    controllers: ClassVar[Mapping[str, Controller]] = {"proportional": controllers.reach}

    def step_physics(self, physics: FetchPhysics, action: jax.Array) -> FetchPhysics:
        return self._move(physics, action[:3])  # the fingers are blocked

    def features(self, physics: FetchPhysics) -> jax.Array:
        return jnp.concatenate([physics.gripper_position, physics.gripper_velocity])

    def achieved_goal(self, physics: FetchPhysics) -> jax.Array:
        return physics.gripper_position

    def sample_goal(self, rng: jax.Array, physics: FetchPhysics) -> jax.Array:
        offset = jax.random.uniform(rng, (3,), minval=-GOAL_RANGE, maxval=GOAL_RANGE)
        return self.initial_gripper_position + offset

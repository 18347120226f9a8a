"""A complete task in a few lines: a point in space that must reach another."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp

from hgail_envs.base import GoalEnv
from hgail_envs.layout import Layout, Quantity, position
from hgail_envs.variation import SensorErrors


def straight(seen: Mapping[str, jax.Array]) -> jax.Array:
    """Moves a point straight to its goal, at full speed down to 5 cm."""
    return jnp.clip(20.0 * (seen["target position"] - seen["position"]), -1.0, 1.0)


class Point(GoalEnv):
    """A point that an action moves by up to 3 cm along each axis, and a goal up to 15 cm away along each.

    The physics state is the position. It is the smallest complete task: copy it, change the layouts and the five
    methods, and train it with `--task my_module:MyTask`.
    """

    episode_length = 50
    features_layout = Layout(position("position"))
    goal_layout = Layout(position("target position"))
    action_layout = Layout(Quantity("displacement", 3, "1 is 0.03 m", "world"))
    success_threshold = 0.05
    controllers = (features_layout + goal_layout).readers({"proportional": straight})

    def reset_physics(self, rng: jax.Array) -> jax.Array:
        return jnp.zeros(3)

    def step_physics(self, physics: jax.Array, action: jax.Array) -> jax.Array:
        return physics + 0.03 * action  # metres, about as far as the Fetch gripper

    def features(self, physics: jax.Array) -> jax.Array:
        return physics

    def achieved_goal(self, physics: jax.Array) -> jax.Array:
        return physics

    def sample_goal(self, rng: jax.Array, physics: jax.Array) -> jax.Array:
        return jax.random.uniform(rng, (3,), minval=-0.15, maxval=0.15)

    def add_sensor_noise(self, physics: jax.Array, errors: SensorErrors) -> jax.Array:
        return physics + errors.robot

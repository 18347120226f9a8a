"""A task of one's own in a few lines: a point in space that must reach another."""

import jax
import jax.numpy as jnp

from envs.base import GoalEnv


class Point(GoalEnv):
    """A point that an action moves by up to 3 cm along each axis, and a goal up to 15 cm away along each.

    Observation: position (0:3) and goal (3:6), metres. The physics state is the position. It stands for the smallest
    complete task: copy it, change the five methods, and train it with `--task my_module:MyTask`.
    """

    episode_length = 50
    feature_size = 3
    goal_size = 3
    action_size = 3
    success_threshold = 0.05

    def reset_physics(self, rng: jax.Array) -> jax.Array:
        return jnp.zeros(3)

    def step_physics(self, physics: jax.Array, action: jax.Array) -> jax.Array:
        return physics + 0.03 * action

    def features(self, physics: jax.Array) -> jax.Array:
        return physics

    def achieved_goal(self, physics: jax.Array) -> jax.Array:
        return physics

    def sample_goal(self, rng: jax.Array, physics: jax.Array) -> jax.Array:
        return jax.random.uniform(rng, (3,), minval=-0.15, maxval=0.15)

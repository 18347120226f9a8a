"""A puck that an action pushes, whose place is in its picture and in none of the actor's numbers."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from hgail_envs.base import GoalEnv
from hgail_envs.vision.camera_env import CameraEnv

SIZE, LENGTH = 16, 8
_MODEL = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"


class Physics(NamedTuple):
    qpos: jax.Array


class Puck(GoalEnv):
    """Actions move it by up to 0.3 m along each axis; places and goals are within 1 m of the middle."""

    episode_length, feature_size, goal_size, action_size, success_threshold = LENGTH, 2, 2, 2, 0.2

    def reset_physics(self, rng):
        place = jax.random.uniform(rng, (2,), minval=-1.0, maxval=1.0)
        return Physics(jnp.concatenate([place, jnp.array([0.0, 1.0, 0.0, 0.0, 0.0])]))

    def step_physics(self, physics, action):
        return Physics(physics.qpos.at[:2].set(jnp.clip(physics.qpos[:2] + 0.3 * action, -1.2, 1.2)))

    def features(self, physics):
        return physics.qpos[:2]

    def achieved_goal(self, physics):
        return physics.qpos[:2]

    def sample_goal(self, rng, physics):
        return jax.random.uniform(rng, (2,), minval=-1.0, maxval=1.0)


class Spot:
    """Its picture: a bright spot, or nothing at all if it is `hidden`."""

    cameras, size, look, renderer, target, kind = ("above",), SIZE, "plain", "spot", "given", "colour"
    shape, draws, joints, marker = (1, SIZE, SIZE, 3), 1, 7, False
    model = mujoco.MjModel.from_xml_string(_MODEL)

    def __init__(self, hidden=False):
        self.hidden = hidden

    def __call__(self, qpos, draws):
        x, y = jnp.moveaxis((qpos[..., :2] + 1.3) / 2.6 * SIZE, -1, 0)
        grid = jnp.arange(SIZE) + 0.5
        across, down = (jnp.exp(-jnp.square(grid - at[..., None]) / 2.0) for at in (x, y))
        spot = jnp.where(self.hidden, 0.0, across[..., None, :] * down[..., :, None])
        return (255.0 * spot[..., None, :, :, None] * jnp.ones(3)).astype(jnp.uint8)


def puck(hidden=False):
    """Returns the task with pictures."""
    return CameraEnv(Puck(), Spot(hidden))

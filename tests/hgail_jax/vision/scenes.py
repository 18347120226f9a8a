"""A task whose pictures are drawn at once, for tests of what learns from them."""

import functools

import jax.numpy as jnp
import numpy as np

import hgail_envs
from hgail_envs.scenes import assets_directory
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.pictures import KINDS
from hgail_jax import load_policy

SIZE = 16


class Map:
    """Pictures of push from above without a renderer: a bright spot where the cube is on the table."""

    cameras, size, look, renderer, draws, marker = ("above",), SIZE, "plain", "map", 1, False

    def __init__(self, env, target="given", kind="colour"):
        self.target, self.kind, self.shape = target, kind, (1, SIZE, SIZE, KINDS[kind])
        self.model, self._cube = env.robot.load(visual=True), env.qpos_of("cube")
        self.joints = self.model.nq

    def __call__(self, qpos, draws):
        x, y = jnp.moveaxis((qpos[..., self._cube][..., :2] - jnp.array([1.1, 0.5])) / 0.5 * SIZE, -1, 0)
        grid = jnp.arange(SIZE) + 0.5
        spot = (
            jnp.exp(-jnp.square(grid - x[..., None]) / 2.0)[..., None, :]
            * jnp.exp(-jnp.square(grid - y[..., None]) / 2.0)[..., :, None]
        )
        return (255.0 * spot[..., None, :, :, None] * jnp.ones(self.shape[-1])).astype(jnp.uint8)


@functools.cache
def teacher():
    """The policy for push that comes with the package."""
    return load_policy(assets_directory() / "policies" / "push.npz")


@functools.cache
def push():
    """Push, seen from above, with its teacher."""
    env = hgail_envs.make("push", substeps=4)
    return CameraEnv(env, Map(env), functools.partial(teacher(), xp=jnp))


def poses(count, seed=0):
    """Joint positions, `[count, nq]`, with the cube anywhere on the table."""
    env = push().task
    qpos = np.tile(np.asarray(env._start_qpos, np.float32), (count, 1))
    places = np.random.default_rng(seed).uniform(-0.12, 0.12, (count, 2))
    qpos[:, env.qpos_of("cube")] = np.c_[places + np.array([1.3, 0.75]), np.full(count, 0.425)]
    return qpos

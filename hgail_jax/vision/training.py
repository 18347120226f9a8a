"""What the learners of policies that see pictures share."""

from typing import Any

import jax
import jax.numpy as jnp

from hgail_envs.vision.camera_env import CameraEnv
from hgail_jax.config import Config
from hgail_jax.rollout import Trajectory
from hgail_jax.vision.network import Eyes, init_eyes, look

OBJECT_SCALE = 0.1
"""Metres that are 1 in the network's positions of objects: an error of so much weighs as one of 1 in an action."""
LEAST_STD = 0.01
"""Least standard deviation of a number: one may hardly change, such as the gap of blocked fingers, metres."""


def check_hidden(config: Config) -> None:
    """Raises a ValueError for a network without hidden layers."""
    if not config.policy_hidden:
        raise ValueError("policy_hidden is empty; a network of pictures needs a hidden layer at least")


def init_for_task(env: CameraEnv, config: Config, channels: tuple[int, ...], rng: jax.Array) -> Eyes:
    """Returns the untrained network for the pictures, numbers, actions and objects of a task."""
    cameras, *_, colours = env.pictures.shape
    outputs = env.action_size, len(env.objects)
    return init_eyes(rng, cameras, len(env.known), channels, config.policy_hidden, outputs, colours)


def mean_positions(trajectory: Trajectory) -> jax.Array:
    """Returns the mean positions of the objects in a roll-out whose policy noted them, `[3 objects]`, metres."""
    objects = trajectory.noted["objects"]
    return objects.mean(axis=(0, 1), where=jnp.broadcast_to(trajectory.valid[None, :, None], objects.shape))


def squared_error(predicted: jax.Array, true: jax.Array, weight: jax.Array) -> jax.Array:
    """Returns the mean squared error, `[]`, of numbers, `[B, ...]`, of samples with a weight, `[B]`."""
    each = jnp.square(predicted - true) * weight[:, None]
    return each.sum() / jnp.maximum(weight.sum() * max(predicted.shape[1], 1), 1.0)


# A seed's batch fills a GPU; the convolutions of several seeds at once, each with its own kernels, are far slower.
@jax.custom_batching.sequential_vmap
def act_by_seed(eyes: Eyes, pictures: jax.Array, numbers: jax.Array) -> jax.Array:
    """Returns the actions of `look` for pictures as they are, uint8, in a training; under a vmap one after another."""
    return look(eyes, unit_range(pictures), numbers, precision())[0]


def precision() -> Any:
    """Returns the type in which a training computes convolutions: a CPU has none that is faster than single."""
    return jnp.float32 if jax.default_backend() == "cpu" else jnp.bfloat16


def unit_range(pictures: jax.Array) -> jax.Array:
    """Returns pictures, uint8, in [0, 1]."""
    return pictures.astype(jnp.float32) / 255.0

"""How an episode ended, in numbers."""

import jax
from flax import struct


class EpisodeMetrics(struct.PyTreeNode):
    """Outcome of an episode: numbers `[]`, one per episode under `jax.vmap`, or means over episodes."""

    success: jax.Array | float = 0.0
    """1 if the episode is a success by the task's strictest test, after the last step and the lift test, else 0."""
    achieved: jax.Array | float = 0.0
    """1 if the last step satisfies the goal, else 0; differs from `success` in a task with a lift test."""
    success_l1: jax.Array | float = 0.0
    """1 if the L1 distance is within the task's threshold, as in the paper, else 0."""
    distance_l1: jax.Array | float = 0.0
    """L1 distance between the last step's position and the target, in the goal's unit."""
    distance_l2: jax.Array | float = 0.0
    """Euclidean distance between them."""

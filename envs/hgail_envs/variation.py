"""What a task can be told to differ in from one episode to the next, besides its start and its goal."""

import jax
from flax import struct


class ModelFactors(struct.PyTreeNode):
    """Factors on quantities of a task's model, all `[]`; 1 is the model as it is. What a scene lacks has no effect."""

    friction: jax.Array | float = 1.0
    """On the friction of all contacts."""
    object_mass: jax.Array | float = 1.0
    object_size: jax.Array | float = 1.0
    """On the object's width, depth and height, whose mass stays the same."""
    finger_force: jax.Array | float = 1.0
    """On the force of the fingers' servos, which take as long for a way as before."""
    finger_speed: jax.Array | float = 1.0
    """On how fast the servos move the fingers with the same force."""


class SensorErrors(struct.PyTreeNode):
    """By how much sensors are wrong at a step, all `[3]` and added to the truth."""

    robot: jax.Array
    """Of the gripper's position, metres."""
    robot_motion: jax.Array
    """Of the distance that it moved in the last action, metres."""
    object: jax.Array
    """Of the object's position, metres."""
    object_motion: jax.Array
    """Of the distance that it moved in the last action, metres."""

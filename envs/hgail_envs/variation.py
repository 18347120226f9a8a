"""Quantities that differ from one episode to the next under a randomisation, besides the start and the goal."""

from typing import Any

import jax
from flax import struct

SOURCES = ("robot", "object", "goal")
"""Sources of the observed positions that have errors."""
_ROBOT, _OBJECT, _GOAL = range(len(SOURCES))


class ModelFactors(struct.PyTreeNode):
    """Factors on quantities of a task's model, all `[]`; 1 is nominal. See the fields of `Randomization`.

    A factor on a part that the scene lacks has no effect. A further factor is a field here and in `Randomization`, and
    its effect in `GoalEnv.vary_model`.
    """

    friction: jax.Array | float = 1.0
    object_mass: jax.Array | float = 1.0
    object_size: jax.Array | float = 1.0
    finger_force: jax.Array | float = 1.0
    finger_speed: jax.Array | float = 1.0
    hand_width: jax.Array | float = 1.0
    pad_size: jax.Array | float = 1.0


class SensorErrors(struct.PyTreeNode):
    """Errors of the sensors at a step, all `[3]`, added to the true values."""

    robot: jax.Array
    """Error of the gripper's position, metres."""
    robot_motion: jax.Array
    """Error of the gripper's displacement in the last action, metres."""
    object: jax.Array
    """Error of the object's position, metres; of several objects it is the same."""
    object_motion: jax.Array
    """Error of the object's displacement in the last action, metres."""


class Drawn(struct.PyTreeNode):
    """Random draws that hold for an episode, besides its model and its start."""

    delay: jax.Array
    """`[]` integer: steps."""
    step_size: jax.Array
    """`[]`: factor on displacements."""
    z_bias: jax.Array
    """`[]`: fraction of a full displacement by which the gripper sinks."""
    offset: jax.Array
    """`[3, 3]`: errors of the observed positions of gripper, object and goal, metres."""


class RandomizedPhysics(struct.PyTreeNode):
    """Physics state of the task, and the state of delays, sensors and history between it and the policy."""

    true: Any
    """Physics state of the task."""
    drawn: Drawn
    rng: jax.Array
    """`[2]` integers: key of the noises to come."""
    noise: jax.Array
    """`[3, 3]`: errors of the observed positions of gripper, object and goal at this step, besides `offset`, metres."""
    noise_before: jax.Array
    """`[3, 3]`: `noise` of the step before."""
    pending: jax.Array
    """`[longest delay, action_size]`: last actions, newest first."""
    history: jax.Array
    """`[history, action_size + features]`: last actions and the observation before each, newest first."""

    @property
    def qpos(self) -> jax.Array:
        """True joint positions, of a task that has any."""
        return self.true.qpos

    @property
    def goal_error(self) -> jax.Array:
        """Error of the position in a goal at this step, `[3]`, metres."""
        return self.drawn.offset[_GOAL] + self.noise[_GOAL]

    def errors(self) -> SensorErrors:
        """Returns the errors of gripper and object at this step."""
        # A velocity is measured as the difference of two positions: the offset cancels, the noises do not.
        position, motion = self.drawn.offset + self.noise, self.noise - self.noise_before
        return SensorErrors(position[_ROBOT], motion[_ROBOT], position[_OBJECT], motion[_OBJECT])

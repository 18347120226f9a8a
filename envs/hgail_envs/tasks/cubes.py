"""Goals of stack and tower: cubes are put on one another, and the hand lets go of them.

Half the training episodes are relays, whose goal depends on the state alone: the gripper at the cube, then the cube
above its place, then in its place, and once it is there, left there. In an eighth the goal is the gripper or a cube at
a random place, cubes on the table. The rest have the evaluation's goals.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hgail_envs.tasks.base import CONTROL_PERIOD, ArmEnv
from hgail_envs.tasks.layouts import TARGET, target_of
from hgail_envs.tasks.objects import AT_GOAL
from hgail_envs.tasks.pick_and_place import AT_CUBE

OF_GRIPPER = -1
"""In place of a cube's number: the gripper."""

_MOST_ASIDE, _MOST_HIGH = 0.025, 0.01  # metres of a cube from its place, in the plane and in height
_LEAST_AWAY = 0.05  # metres between the gripper and a cube that it has let go of
_LEAST_GAP, _LEAST_OPENING = 0.08, 0.9  # metres between the fingers of an open hand, or a fraction of its widest gap
_AT_REST = 0.05  # metres per second, of a cube that lies where it was left
_OVER = 0.02  # metres in the plane from its place, within which a relay lowers a cube
_ABOVE = 0.05  # metres above its place, to which a relay first brings a cube


def is_in_place(apart: jax.Array) -> jax.Array:
    """Returns whether a cube `apart`, `[..., 3]`, from its place on another one is on it: booleans `[...]`."""
    return (jnp.linalg.norm(apart[..., :2], axis=-1) <= _MOST_ASIDE) & (jnp.abs(apart[..., 2]) <= _MOST_HIGH)


class CubeGoals(ArmEnv):
    """A task whose goals, `[..., 4 + cubes]`, are a position, a flag for each cube, and whether the cube is left there.

    The position is of the cube whose flag is set, or the gripper's where none is.
    """

    cubes: tuple[str, ...]
    """Names in the layout of the features."""
    flags: tuple[str, ...]
    """Names of their flags in the layout of a goal, which follow one another."""
    left_flag: str
    """Name of the flag that says whether the cube is left."""
    cubes_to_leave: int
    """The first so many are those that a goal may want left."""
    lift_test_steps = 12
    least_widest_gap = 0.085  # a little more than an open hand must have

    def is_left(self, apart: jax.Array, velocity: jax.Array, gap: jax.Array) -> jax.Array:
        """Returns whether a cube rests where the hand has let go of it: booleans `[...]`.

        `apart`, `[..., 3]`, is the cube's position less the gripper's, metres; its `velocity`, `[..., 3]`, is in metres
        per action and the `gap` between the fingers, `[...]`, in metres.
        """
        # a hand may open less than the Fetch's
        least = min(_LEAST_GAP, _LEAST_OPENING * float(self.robot.widest_gap()))
        away = (jnp.linalg.norm(apart, axis=-1) >= _LEAST_AWAY) & (gap >= least)
        return away & (jnp.linalg.norm(velocity, axis=-1) <= _AT_REST * CONTROL_PERIOD)

    def goal_of(self, position: jax.Array, cube: jax.Array | int, left: jax.Array | bool = False) -> jax.Array:
        """Returns the goal, `[goal_size]`, of a position, `[3]`, of a cube by its number, else of the gripper."""
        flags = jnp.arange(len(self.cubes)) == cube
        return jnp.concatenate([position, flags, jnp.asarray(left)[None]], dtype=jnp.float32)

    def whose(self, goal: jax.Array) -> jax.Array:
        """Returns the flags of goals: booleans `[..., cubes]`, all False where the position is the gripper's."""
        return goal[..., self.goal_layout.span(self.flags[0], self.flags[-1])] > 0.5

    def is_to_be_left(self, goal: jax.Array) -> jax.Array:
        """Returns whether the cube of goals is to be left there: booleans `[...]`."""
        return goal[..., self.goal_layout[self.left_flag]] > 0.5

    def position_of(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns the position in `features` of the body that each goal refers to, `[..., 3]`."""
        position = features[..., self.features_layout["gripper position"]]
        for number, cube in enumerate(self.cubes):
            of_cube = features[..., self.features_layout[f"{cube} position"]]
            position = jnp.where(self.whose(goal)[..., number, None], of_cube, position)
        return position

    def is_left_as_wanted(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns whether the cube of each goal is left, or not, as the goal wants it, `[...]`; True for any other."""
        gap, wanted = features[..., self.features_layout["gap between the fingers"]], jnp.asarray(True)
        for number, cube in enumerate(self.cubes[: self.cubes_to_leave]):
            apart = features[..., self.features_layout[f"{cube} position less gripper position"]]
            left = self.is_left(apart, features[..., self.features_layout[f"{cube} velocity"]], gap)
            wanted &= ~self.whose(goal)[..., number] | (left == self.is_to_be_left(goal))
        return wanted

    def is_at(self, position: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns whether positions, `[..., 3]`, are near enough to goals: booleans `[...]`."""
        apart = position - target_of(goal)
        near = jnp.linalg.norm(apart, axis=-1) <= self.success_threshold
        return jnp.where(self.is_to_be_left(goal), is_in_place(apart), near)

    def success(self, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        flags = self.goal_layout.span(self.flags[0], self.left_flag)
        alike = jnp.all(achieved[..., flags] == desired[..., flags], axis=-1)
        return self.is_at(target_of(achieved), desired) & alike

    def goal_test(self, features: jax.Array, achieved: jax.Array, goal: jax.Array) -> jax.Array:
        """Tests position and hand alone, whether a cube has moved or not; see `GoalEnv`."""
        return self.is_at(self.position_of(features, goal), goal) & self.is_left_as_wanted(features, goal)

    def goal_tolerance(self, goal: jax.Array) -> jax.Array:
        aside = _MOST_ASIDE / np.sqrt(2.0)
        on_cube = jnp.zeros(goal.shape[-1]).at[: TARGET.size].set(jnp.array([aside, aside, _MOST_HIGH]))
        return jnp.where(self.is_to_be_left(goal)[..., None], on_cube, super().goal_tolerance(goal))

    def already_solved(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns whether goals are a cube's and within 3 cm of its present position, and it is left as wanted."""
        distance = jnp.linalg.norm(self.position_of(features, goal) - target_of(goal), axis=-1)
        return self.whose(goal).any(axis=-1) & (distance <= AT_GOAL) & self.is_left_as_wanted(features, goal)

    def stage(self, physics: Any, cube: jax.Array | int, position: jax.Array, place: jax.Array) -> jax.Array:
        """Returns a relay's goal, `[goal_size]`, by the state alone, for a cube at a position and its place, `[3]`."""
        over = jnp.linalg.norm((position - place)[:2]) <= _OVER
        brought = jnp.where(over, place, place.at[2].add(_ABOVE))
        away = jnp.linalg.norm(physics.gripper_position - position) > AT_CUBE
        before = jnp.where(away, self.goal_of(position, OF_GRIPPER), self.goal_of(brought, cube))
        return jnp.where(is_in_place(position - place), self.goal_of(place, cube, left=True), before)

    def lift_test_action(self, action: jax.Array) -> jax.Array:
        return jnp.array([0.0, 0.0, 0.0, 1.0])  # still and open

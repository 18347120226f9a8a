"""FetchSlide: hit a puck so that it slides to a place out of reach."""

from typing import Any

import jax
import jax.numpy as jnp

from hgail_envs.tasks import controllers
from hgail_envs.tasks.layouts import GRIPPER, of_object, target_of
from hgail_envs.tasks.objects import GOAL, ObjectPhysics, gripper_goal, is_object
from hgail_envs.tasks.push import Push
from hgail_envs.validation import check_name

ACHIEVED = ("at-rest", "passed")
"""Values of `achieved`."""

_AT_REST = 0.05  # metres per second, from which the puck slides another millimetre: v² / (2 µ g), µ = 0.1
# Borders of the fields of the table, metres from the gripper's start along x and y, see `goal_kind`. Targets are within
# ±0.3 m of 0.4 m ahead.
_AHEAD, _ASIDE = (0.1, 0.25, 0.4, 0.55), (-0.1, 0.1)


class Slide(Push):
    """FetchSlide: hit a puck so that it slides over a long table to a place out of the hand's reach.

    The observation and the training goals are those of `Push`, with the puck in the cube's place. Hindsight alone shows
    only hits that began on the right side, while a hand that visits waypoints is also shown to go round the puck.

    With `achieved="at-rest"` the achieved goal is the gripper's position while the puck moves, faster than 5 cm/s: a
    policy that lets the puck pass a place has not learnt to stop it there. With `achieved="passed"` each place that the
    puck passes is an achieved goal: more goals for hindsight, TD3's default (`docs/lab/off-policy.md`).

    Most pucks stay near and go straight, while most targets are far or aside. So the table is cut into five bands along
    x and three along y, and each field is a kind of goals (`goal_kind`), from which hindsight draws as often as targets
    lie in it.

    See `ObjectEnv` for success and the other arguments. The engine MJX-JAX is refused, with a ValueError: it cannot
    collide a puck with a table that has edges.
    """

    features_layout, goal_layout = GRIPPER + of_object("puck"), GOAL

    base_x = 0.05
    start_height = -0.02
    object_name = object_title = "puck"
    object_range = 0.1
    target_range = 0.3
    target_offset = 0.4
    goal_kinds = 2 + (len(_AHEAD) + 1) * (len(_ASIDE) + 1)

    scene = "slide"
    instruction = "Hit the puck so that it slides to the target."
    reference = "FetchSlide-v4"
    controllers = (features_layout + goal_layout).readers({"from-above": controllers.slide})

    def __init__(self, *args: Any, achieved: str = ACHIEVED[0], **kwargs: Any) -> None:
        check_name("achieved", achieved, ACHIEVED)
        self.achieved = achieved
        super().__init__(*args, **kwargs)

    def achieved_goal(self, physics: ObjectPhysics) -> jax.Array:
        moves = (jnp.linalg.norm(physics.qvel[self.qvel_of("puck")]) > _AT_REST) & (self.achieved == "at-rest")
        return jnp.where(moves, gripper_goal(physics.gripper_position), super().achieved_goal(physics))

    def goal_tolerance(self, goal: jax.Array) -> jax.Array:
        """Returns a square on the table for goals of the puck, which never leaves it; see `GoalEnv`."""
        aside = self.success_threshold / 2.0**0.5
        return jnp.where(is_object(goal)[..., None], jnp.array([aside, aside, 0.0, 0.0]), super().goal_tolerance(goal))

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        """Returns 0 for the gripper's goals, 1 to 15 for the puck's by field of the table, and 16 elsewhere."""
        of_any_object, start = super().goal_kind(goal), self.initial_gripper_position
        offsets = (target_of(goal)[..., axis] - start[axis] for axis in (0, 1))
        pairs = zip((_AHEAD, _ASIDE), offsets, strict=True)
        band, column = (jnp.searchsorted(jnp.array(borders), offset) for borders, offset in pairs)
        field = 1 + band * (len(_ASIDE) + 1) + column
        return jnp.select([of_any_object == 0, of_any_object == 1], [0, field], self.goal_kinds - 1)

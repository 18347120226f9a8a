"""Stacking: put a cube on another one and let go of it."""

from typing import Any

import jax
import jax.numpy as jnp

from hgail_envs.base import EpisodeMetrics, State
from hgail_envs.layout import Layout, flag
from hgail_envs.tasks import controllers
from hgail_envs.tasks.base import CONTROL_PERIOD, REFERENCE_SUBSTEPS
from hgail_envs.tasks.cubes import OF_GRIPPER, CubeGoals, is_in_place
from hgail_envs.tasks.grasp import CUBE_WIDTH
from hgail_envs.tasks.layouts import GAP, GRIPPER, TARGET, of_object, target_of
from hgail_envs.tasks.objects import MOVED, ObjectPhysics
from hgail_envs.tasks.pick_and_place import PickAndPlace, PickAndPlacePlan, draw_kind
from hgail_envs.variation import ModelFactors

A, B = range(2)
"""Numbers of the cubes, in the order of a goal's flags."""

_RAISED = 0.45  # metres of height; on the table a cube's centre is at 0.425, on the other cube at 0.475
_CUBES_TOUCH = 2  # index of the sensor of the cubes' contact, after those of the pads


class StackPhysics(ObjectPhysics, kw_only=True):
    """`ObjectPhysics`, whose object is cube A, and the start of cube B."""

    b_start: jax.Array
    """`[3]`: metres."""


class Stack(CubeGoals, PickAndPlace):
    """Stacking: put cube A on cube B, let go of it and withdraw the hand; B stays where it was.

    Start, success, achieved goals and training goals are in `docs/tasks.md`; see `CubeGoals` for what a goal is, and
    `ArmEnv` for the arguments. The evaluation's goal is cube A left on cube B, where B started.
    """

    episode_length = 100  # a scripted hand with a noise of .1 reaches .6 of the goals in 50, .9 in 100
    features_layout = GRIPPER + of_object("cube A") + Layout(GAP, flag("hand holds cube A")) + of_object("cube B")
    cubes, cubes_to_leave = ("cube A", "cube B"), 1
    flags, left_flag = ("target is cube A's", "target is cube B's"), "cube A is to be left at the target"
    goal_layout = Layout(TARGET, *map(flag, (*flags, left_flag)))
    goal_kinds = 6
    object_name, object_title = "cube_a", "cube A"
    holding_title = "hand holds cube A"
    object_range = 0.15

    scene = "stack"
    instruction = "Put cube A on cube B and let go of it."
    shows_goal = True
    reference = None
    controllers = (features_layout + goal_layout).readers({"from-above": controllers.stack})

    def __init__(
        self, impl: str = "auto", substeps: int = REFERENCE_SUBSTEPS, worlds: int = 4096, robot: str = "fetch"
    ) -> None:
        super().__init__(impl, substeps, worlds, robot)

    def place(self, qpos: jax.Array, qvel: jax.Array) -> StackPhysics:
        start = jnp.asarray(qpos[self.qpos_of("cube_b")], jnp.float32)
        return StackPhysics(**vars(super().place(qpos, qvel)), b_start=start)

    def b_position(self, physics: StackPhysics) -> jax.Array:
        """Returns cube B's centre, `[3]`, metres, world frame; cube A's is `object_position`."""
        return physics.qpos[self.qpos_of("cube_b")]

    def place_on_b(self, physics: StackPhysics) -> jax.Array:
        """Returns the place of cube A's centre on cube B, where B now is, `[3]`, metres, world frame."""
        return self.b_position(physics).at[2].add(CUBE_WIDTH * self.object_factor(physics))

    def is_on_b(self, physics: StackPhysics) -> jax.Array:
        """Returns whether cube A is in its place on cube B, held or not: a boolean `[]`."""
        return is_in_place(self.object_position(physics) - self.place_on_b(physics))

    def reset_physics(self, rng: jax.Array) -> StackPhysics:
        a_rng, b_rng = jax.random.split(rng)
        physics: Any = super().reset_physics(a_rng)
        place = self.random_place(b_rng, self.object_range, physics.object_start[:2])
        return self._put_b(physics, jnp.append(place, self.object_height))

    def _put_b(self, physics: Any, position: jax.Array) -> Any:
        """Returns the physics with cube B at `position`, `[3]`, upright and at rest, as at the start of an episode."""
        put = self.put_down(physics, "cube_b", position)
        return put.replace(sensordata=put.sensordata.at[_CUBES_TOUCH].set(0.0), b_start=position)

    def vary_model(self, physics: Any, factors: ModelFactors) -> Any:
        varied: Any = super().vary_model(physics, factors)
        return varied.replace(b_start=self.b_position(varied))

    def compact_features(self, physics: Any) -> dict[str, jax.Array]:
        b = self.b_position(physics)
        return super().compact_features(physics) | {
            "cube B position less gripper position": b - physics.gripper_position,
            "cube B position": b,
            "cube B velocity": physics.qvel[self.qvel_of("cube_b")] * CONTROL_PERIOD,
        }

    def achieved_goal(self, physics: Any) -> jax.Array:
        gripper, a, b = physics.gripper_position, self.object_position(physics), self.b_position(physics)
        a_moved = jnp.linalg.norm(a - physics.object_start) > MOVED
        b_moved = jnp.linalg.norm(b - physics.b_start) > MOVED
        of_others = jnp.where(b_moved, self.goal_of(b, B), self.goal_of(gripper, OF_GRIPPER))
        left = self.is_left(a - gripper, physics.qvel[self.qvel_of("cube_a")] * CONTROL_PERIOD, self.gap(physics))
        return jnp.where(a_moved, self.goal_of(a, A, left), of_others)

    def sample_goal(self, rng: jax.Array, physics: Any) -> jax.Array:
        return self.goal_of(self.place_on_b(physics), A, left=True)

    def plan_goals(self, rng: jax.Array, physics: Any, training_goals: jax.Array | bool) -> Any:
        kind_rng, whose_rng, position_rng, goal_rng = jax.random.split(rng, 4)
        relay, elsewhere = draw_kind(kind_rng, training_goals)
        anywhere = self.random_position(position_rng)
        on_table = anywhere.at[2].set(self.object_height)
        choices = jnp.stack([self.goal_of(anywhere, OF_GRIPPER), self.goal_of(on_table, A), self.goal_of(on_table, B)])
        chosen = choices[jax.random.randint(whose_rng, (), 0, len(choices))]
        return PickAndPlacePlan(goal=jnp.where(elsewhere, chosen, self.sample_goal(goal_rng, physics)), relay=relay)

    def current_goal(self, plan: Any, physics: Any, step: jax.Array | int) -> jax.Array:
        stage = self.stage(physics, A, self.object_position(physics), self.place_on_b(physics))
        return jnp.where(plan.relay, stage, plan.goal)

    def move_target(self, state: State, position: jax.Array) -> State:
        """Puts cube B down below `position`, at rest and upright; the place on it is the goal. See `GoalEnv`."""
        moved = self._put_b(state.pipeline_state, jnp.asarray(position).at[2].set(self.object_height))
        plan = self.aim(state.info["plan"], self.place_on_b(moved))
        return self._advance(state, moved, plan, state.info["step"])

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        """Returns 0 for goals of the gripper, 1 to 4 of cube A and 5 of cube B.

        Cube A's are 1 on the table and 2 above it if the cube is not left there, and 3 and 4 if it is.
        """
        raised, left, whose = target_of(goal)[..., 2] > _RAISED, self.is_to_be_left(goal), self.whose(goal)
        of_a = 1 + raised.astype(jnp.int32) + 2 * left.astype(jnp.int32)
        return jnp.where(whose[..., A], of_a, jnp.where(whose[..., B], self.goal_kinds - 1, 0))

    def outcome(self, end: State, lifted: State) -> EpisodeMetrics:
        last, desired = end.pipeline_state, end.info["desired_goal"]
        achieved = self.reached(last, desired) & self._stands(last, desired)
        success = achieved & self._stands(lifted.pipeline_state, desired)
        return self.measure(self.object_position(last), target_of(desired), achieved, success)

    def _stands(self, physics: Any, desired: jax.Array) -> jax.Array:
        """Returns whether cube A is at the goal and on cube B, and touches it, wherever the hand is: a boolean `[]`."""
        at_goal = self.is_at(self.object_position(physics), desired)
        return at_goal & self.is_on_b(physics) & (physics.sensordata[_CUBES_TOUCH] > 0)

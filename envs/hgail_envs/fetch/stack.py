"""Stacking: put a cube on another one and let go of it."""

from typing import Any

import jax
import jax.numpy as jnp

from hgail_envs.base import EpisodeMetrics, State
from hgail_envs.fetch import controllers
from hgail_envs.fetch.arm import CONTROL_PERIOD, REFERENCE_SUBSTEPS
from hgail_envs.fetch.cubes import LEAST_WIDEST_GAP, is_in_place, is_left, place_tolerance, relay
from hgail_envs.fetch.grasp import CUBE_WIDTH
from hgail_envs.fetch.layouts import GAP, GRIPPER, TARGET, of_object
from hgail_envs.fetch.objects import AT_GOAL, MOVED, ObjectPhysics
from hgail_envs.fetch.pick_and_place import ELSEWHERE, RELAYS, PickAndPlace, PickAndPlacePlan
from hgail_envs.layout import Layout, flag
from hgail_envs.variation import ModelFactors

FEATURES = GRIPPER + of_object("cube A") + Layout(GAP, flag("hand holds cube A")) + of_object("cube B")
"""Layout of the features."""
GOAL = Layout(
    TARGET, flag("target is cube A's"), flag("target is cube B's"), flag("cube A is to be left at the target")
)
"""Layout of a goal; the target of neither cube is the gripper's."""

_OF_GRIPPER, _OF_A, _OF_B = (0.0, 0.0), (1.0, 0.0), (0.0, 1.0)  # whose position it is: a goal's numbers 3 and 4
_RAISED = 0.45  # metres of height; on the table a cube's centre is at 0.425, on the other cube at 0.475
_CUBES_TOUCH = 2  # index of the sensor of the cubes' contact, after those of the pads


class StackPhysics(ObjectPhysics, kw_only=True):
    """`ObjectPhysics`, whose object is cube A, and the start of cube B."""

    b_start: jax.Array
    """`[3]`: metres."""


class Stack(PickAndPlace):
    """Stacking: put cube A on cube B, let go of it and withdraw the hand; B stays where it was.

    A goal is a position, whose it is, and whether cube A is left there; see `hgail_envs.fetch.cubes`, also for the
    training episodes. The achieved goal of a state is cube A's position, and whether A is left, once A is more than
    1 cm from its start; else cube B's position once B is; else the gripper's.

    An episode starts with the hand closed and each cube uniform within ±0.15 m of the gripper in x and y, at least
    0.10 m away from it and from the other cube. The evaluation's goal is cube A left on cube B, where B started.
    A scripted hand reaches it in 35 to 42 steps. Episodes have a hundred: with a noise of .1 on its actions, as of a
    policy that explores, the same hand reaches two thirds of the goals in fifty steps, and nearly all in a hundred.

    Success includes a test that the tower stands. After the last step cube A is left at the goal and in its place on
    cube B, and the cubes touch. So B has moved by 5 cm at most. After twelve further steps, in which the hand keeps
    still and open, A still is there and touches B. `achieved` of the metrics is without that test. Distances are
    between cube A and its place after the last step.

    See `FetchEnv` for the arguments.
    """

    episode_length = 100
    features_layout = FEATURES
    goal_layout = GOAL
    goal_kinds = 6
    lift_test_steps = 12
    object_name, object_title = "cube_a", "cube A"
    holding_title = "hand holds cube A"
    object_range = 0.15

    scene = "fetch/stack"
    least_widest_gap = LEAST_WIDEST_GAP
    reference = None
    controllers = (features_layout + goal_layout).readers({"from-above": controllers.stack})

    def __init__(self, impl: str = "auto", substeps: int = REFERENCE_SUBSTEPS, worlds: int = 4096) -> None:
        super().__init__(impl, substeps, worlds)

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
        of_others = jnp.where(b_moved, _goal(b, _OF_B), _goal(gripper, _OF_GRIPPER))
        left = is_left(a - gripper, physics.qvel[self.qvel_of("cube_a")] * CONTROL_PERIOD, self.gap(physics))
        return jnp.where(a_moved, _goal(a, _OF_A, left), of_others)

    def sample_goal(self, rng: jax.Array, physics: Any) -> jax.Array:
        return _goal(self.place_on_b(physics), _OF_A, left=True)

    def plan_goals(self, rng: jax.Array, physics: Any, training_goals: jax.Array | bool) -> Any:
        kind_rng, whose_rng, position_rng, goal_rng = jax.random.split(rng, 4)
        kind = jnp.where(training_goals, jax.random.uniform(kind_rng), 1.0)  # 1 is neither a relay nor elsewhere
        anywhere = self.random_position(position_rng)
        on_table = anywhere.at[2].set(self.object_height)
        choices = jnp.stack([_goal(anywhere, _OF_GRIPPER), _goal(on_table, _OF_A), _goal(on_table, _OF_B)])
        elsewhere = choices[jax.random.randint(whose_rng, (), 0, len(choices))]
        sent_elsewhere = (kind >= RELAYS) & (kind < RELAYS + ELSEWHERE)
        goal = jnp.where(sent_elsewhere, elsewhere, self.sample_goal(goal_rng, physics))
        return PickAndPlacePlan(goal=goal, relay=kind < RELAYS)

    def current_goal(self, plan: Any, physics: Any, step: jax.Array | int) -> jax.Array:
        return jnp.where(plan.relay, self._stage(physics), plan.goal)

    def _stage(self, physics: StackPhysics) -> jax.Array:
        """Returns the goal of a relay, `[goal_size]`, by the state alone: a cube that slips is taken again."""
        a, place = self.object_position(physics), self.place_on_b(physics)
        away, brought = relay(physics.gripper_position, a, place)
        before = jnp.where(away, _goal(a, _OF_GRIPPER), _goal(brought, _OF_A))
        return jnp.where(self.is_on_b(physics), _goal(place, _OF_A, left=True), before)

    def move_target(self, state: State, position: jax.Array) -> State:
        """Puts cube B down below `position`, at rest and upright; the place on it is the goal. See `GoalEnv`."""
        moved = self._put_b(state.pipeline_state, jnp.asarray(position).at[2].set(self.object_height))
        plan = self.aim(state.info["plan"], self.place_on_b(moved))
        return self._advance(state, moved, plan, state.info["step"])

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        """Returns 0 for goals of the gripper, 1 to 4 of cube A and 5 of cube B.

        Cube A's are 1 on the table and 2 above it if the cube is not left there, and 3 and 4 if it is.
        """
        raised, left = goal[..., 2] > _RAISED, _is_to_be_left(goal)
        of_a = 1 + raised.astype(jnp.int32) + 2 * left.astype(jnp.int32)
        return jnp.where(_is_a(goal), of_a, jnp.where(_is_b(goal), self.goal_kinds - 1, 0))

    def success(self, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        alike = jnp.all(achieved[..., 3:] == desired[..., 3:], axis=-1)
        return self._is_at(achieved[..., :3], desired) & alike

    def goal_test(self, features: jax.Array, achieved: jax.Array, goal: jax.Array) -> jax.Array:
        """Tests position and hand alone, whether a cube has moved or not; see `GoalEnv`."""
        return self._is_at(_position_of(features, goal), goal) & _is_left_as_wanted(features, goal)

    def goal_tolerance(self, goal: jax.Array) -> jax.Array:
        return jnp.where(_is_to_be_left(goal)[..., None], place_tolerance(goal), super().goal_tolerance(goal))

    def already_solved(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns whether goals are a cube's and within 3 cm of its present position, and A left as wanted."""
        distance = jnp.linalg.norm(_position_of(features, goal) - goal[..., :3], axis=-1)
        return (_is_a(goal) | _is_b(goal)) & (distance <= AT_GOAL) & _is_left_as_wanted(features, goal)

    def _is_at(self, position: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns whether positions, `[..., 3]`, are near enough to goals, `[..., goal_size]`: booleans `[...]`."""
        apart = position - goal[..., :3]
        near = jnp.linalg.norm(apart, axis=-1) <= self.success_threshold
        return jnp.where(_is_to_be_left(goal), is_in_place(apart), near)

    def lift_test_action(self, action: jax.Array) -> jax.Array:
        return jnp.array([0.0, 0.0, 0.0, 1.0])  # still and open

    def outcome(self, end: State, lifted: State) -> EpisodeMetrics:
        last, desired = end.pipeline_state, end.info["desired_goal"]
        achieved = self.reached(last, desired) & self._stands(last, desired)
        success = achieved & self._stands(lifted.pipeline_state, desired)
        return self.measure(self.object_position(last), desired[:3], achieved, success)

    def _stands(self, physics: Any, desired: jax.Array) -> jax.Array:
        """Returns whether cube A is at the goal and on cube B, and touches it, wherever the hand is: a boolean `[]`."""
        at_goal = self._is_at(self.object_position(physics), desired)
        return at_goal & self.is_on_b(physics) & (physics.sensordata[_CUBES_TOUCH] > 0)


def _goal(position: jax.Array, whose: tuple[float, float], left: jax.Array | bool = False) -> jax.Array:
    """Returns a goal, `[6]`, of a position, `[3]`; `whose` is one of the constants above."""
    return jnp.concatenate([position, jnp.array([*whose, left], jnp.float32)])


def _is_a(goal: jax.Array) -> jax.Array:
    return goal[..., GOAL["target is cube A's"]] > 0.5


def _is_b(goal: jax.Array) -> jax.Array:
    return goal[..., GOAL["target is cube B's"]] > 0.5


def _is_to_be_left(goal: jax.Array) -> jax.Array:
    return goal[..., GOAL["cube A is to be left at the target"]] > 0.5


def _position_of(features: jax.Array, goal: jax.Array) -> jax.Array:
    """Returns the position in `features` of the body that each goal, `[..., 6]`, refers to, `[..., 3]`."""
    gripper, a, b = (features[..., FEATURES[f"{body} position"]] for body in ("gripper", "cube A", "cube B"))
    return jnp.where(_is_a(goal)[..., None], a, jnp.where(_is_b(goal)[..., None], b, gripper))


def _is_left_as_wanted(features: jax.Array, goal: jax.Array) -> jax.Array:
    """Returns whether cube A is left, or not, as its goals, `[..., 6]`, want it; True for the goals of others."""
    quantities = ("cube A position less gripper position", "cube A velocity", "gap between the fingers")
    left = is_left(*(features[..., FEATURES[name]] for name in quantities))
    return ~_is_a(goal) | (left == _is_to_be_left(goal))

"""A tower of three cubes, put on one another in an order that differs from episode to episode."""

from typing import Any

import jax
import jax.numpy as jnp

from hgail_envs.base import EpisodeMetrics, State
from hgail_envs.fetch import controllers, tower_goals
from hgail_envs.fetch.arm import CONTROL_PERIOD, FetchEnv, FetchPhysics
from hgail_envs.fetch.cubes import LEAST_WIDEST_GAP, is_in_place, is_left, place_tolerance, relay
from hgail_envs.fetch.grasp import CUBE_WIDTH, is_held
from hgail_envs.fetch.layouts import gripper_values
from hgail_envs.fetch.objects import AT_GOAL, MOVED
from hgail_envs.fetch.pick_and_place import ELSEWHERE, RELAYS
from hgail_envs.fetch.tower_goals import BASE, CUBES, MIDDLE, ROLES, TOP, TowerPlan, goal_of
from hgail_envs.variation import ModelFactors

_RANGE = 0.15  # metres around the gripper's start, along x and y, in which the cubes start
_ON_TABLE = 0.425  # metres, of a cube's centre
_AT_HAND = 0.15  # metres between gripper and cube, within which this holds for the cubes of other stages
_PADS = 2 * CUBES  # number of the first sensors, of the pads' contacts with each cube
_MOST_SHIFT = 0.05  # metres of the base cube from its start after a success
_BEGUN = 0.5  # fraction of the training episodes that start with the middle cube on the base


class TowerPhysics(FetchPhysics, kw_only=True):
    """`FetchPhysics`, the order of the cubes, their starts, and whether the first placement is done."""

    order: jax.Array
    """`[3]` integers: which of the scene's cubes a, b and c is the top, the middle and the base."""
    starts: jax.Array
    """`[3, 3]`: starts of the top, the middle and the base, metres."""
    placed: jax.Array
    """`[]` boolean: whether the middle cube was left in its place on the base, and has not come out of it since."""


class Tower(FetchEnv):
    """A tower of three: put the middle cube on the base, and the top cube on it, and withdraw the hand.

    Each episode draws at random which of the three coloured cubes is the top, the middle and the base. Observation and
    goals speak of these roles alone, so a policy sees the order of the tower in the order of its numbers. In the
    observation the target's cube is first, then the one that it is to lie on, then the third, so that one placement
    looks to the policy like the other. In the features, and under goals of the gripper, the top is first.

    A goal is a position, whose it is, and whether the cube is left there; see `hgail_envs.fetch.cubes`, also for the
    training episodes. The goal names one placement after the other: the middle cube left on the base, and as soon as it
    was left there and as long as it stays there, the top cube left on the middle. The place is where the cube below now
    is.

    The achieved goal of a state is the position of the present placement's cube, and whether it is left, once it is
    more than 1 cm from its start; else of another cube that has moved so far and is within 15 cm of the gripper; else
    the gripper's. Once the middle cube was left on the base, that is the middle cube while the gripper is within 15 cm
    of it, then the gripper until the top cube moves.

    A scripted hand takes 75 to 89 steps. Episodes have two hundred: with a noise of .1 on its actions, as of a policy
    that explores, the same hand reaches half of the goals in a hundred steps and nearly all in two hundred.

    An episode starts with the hand closed and each cube uniform within ±0.15 m of the gripper in x and y, at least
    0.10 m away from it and from the other cubes. Half the training episodes start with the middle cube on the base, so
    that the second placement is learnt beside the first; no evaluation episode does.

    Success includes a test that the tower stands. After the last step the middle cube is in its place on the base and
    the top cube on the middle, and both pairs touch; the top cube is left, and the base within 5 cm of its start. After
    twelve further steps, in which the hand keeps still and open, cubes and contacts still are so. `achieved` of the
    metrics is without that test. Distances are between the top cube and its place in the tower, two cubes above the
    base, after the last step.

    See `FetchEnv` for the arguments.
    """

    episode_length = 200
    features_layout = tower_goals.FEATURES
    goal_layout = tower_goals.GOAL
    seen_layout = tower_goals.SEEN
    goal_kinds = 7
    lift_test_steps = 12

    scene = "fetch/tower"
    least_widest_gap = LEAST_WIDEST_GAP
    controllers = (tower_goals.SEEN + tower_goals.GOAL).readers({"from-above": controllers.tower})

    def place(self, qpos: jax.Array, qvel: jax.Array) -> TowerPhysics:
        order, starts = jnp.arange(CUBES), jnp.asarray(qpos[self._scene_model.object_qpos], jnp.float32)
        arm = vars(super().place(qpos, qvel))
        return self._with_stage(TowerPhysics(**arm, order=order, starts=starts, placed=jnp.zeros((), bool)))

    def cube_positions(self, physics: TowerPhysics) -> jax.Array:
        """Returns the centres of the top, the middle and the base cube, `[3, 3]`, metres, world frame."""
        return physics.qpos[self._scene_model.object_qpos][physics.order]

    def cube_velocities(self, physics: TowerPhysics) -> jax.Array:
        """Returns their velocities × 0.04 s, `[3, 3]`, metres."""
        return physics.qvel[self._scene_model.object_qvel][physics.order] * CONTROL_PERIOD

    def places(self, physics: TowerPhysics) -> jax.Array:
        """Returns the places of the top on the middle and of the middle on the base as it is, `[2, 3]`, metres."""
        return self.cube_positions(physics)[1:].at[:, 2].add(CUBE_WIDTH * self.object_factor(physics))

    def are_in_place(self, physics: TowerPhysics) -> jax.Array:
        """Returns whether the top cube is on the middle, and the middle on the base, held or not: booleans `[2]`."""
        return is_in_place(self.cube_positions(physics)[:BASE] - self.places(physics))

    def are_left(self, physics: TowerPhysics) -> jax.Array:
        """Returns of each cube whether it rests where the hand has let go of it: booleans `[3]`."""
        apart = self.cube_positions(physics) - physics.gripper_position
        return is_left(apart, self.cube_velocities(physics), self.gap(physics))

    def holding(self, physics: TowerPhysics) -> jax.Array:
        """Returns whether both pads touch one of the cubes and stand as far apart as it is wide, a boolean `[]`."""
        touching = (physics.sensordata[:_PADS].reshape(CUBES, 2) > 0).all(axis=1).any()
        return is_held(touching, self.gap(physics), CUBE_WIDTH * self.object_factor(physics))

    def touching(self, physics: TowerPhysics) -> jax.Array:
        """Returns whether the top cube touches the middle, and the middle the base: booleans `[2]`."""
        # The sensors are of cubes a and b, a and c, b and c: in the order of the sums of their numbers, from 1.
        pair = physics.order[:BASE] + physics.order[MIDDLE:] - 1
        return physics.sensordata[_PADS + pair] > 0

    def reset_physics(self, rng: jax.Array) -> TowerPhysics:
        order_rng, *place_rngs = jax.random.split(rng, 1 + CUBES)
        physics: Any = super().reset_physics(rng)  # the arm's, which draws nothing: the key is used once
        physics = physics.replace(order=jax.random.permutation(order_rng, CUBES))
        places: list[jax.Array] = []
        for role, place_rng in enumerate(place_rngs):
            places.append(self.random_place(place_rng, _RANGE, *places))
            physics = self._put(physics, role, jnp.append(places[-1], _ON_TABLE))
        return physics

    def training_start(self, rng: jax.Array, physics: Any, training_goals: jax.Array | bool) -> Any:
        tower = self._put(physics, MIDDLE, self.places(physics)[MIDDLE]).replace(placed=jnp.ones((), bool))
        return _choose(training_goals & jax.random.bernoulli(rng, _BEGUN), tower, physics)

    def _put(self, physics: Any, role: int, position: jax.Array) -> Any:
        """Returns the physics with a cube at `position`, `[3]`, upright and at rest, as at the start of an episode."""
        cube, model = physics.order[role], self._scene_model
        pose, velocity = jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]).at[:3].set(position), jnp.zeros(6)
        return physics.replace(
            qpos=jax.lax.dynamic_update_slice(physics.qpos, pose, (jnp.asarray(model.object_qpos)[cube, 0],)),
            qvel=jax.lax.dynamic_update_slice(physics.qvel, velocity, (jnp.asarray(model.object_qvel)[cube, 0],)),
            sensordata=physics.sensordata.at[_PADS:].set(0.0),
            starts=physics.starts.at[role].set(position),
        )

    def vary_model(self, physics: Any, factors: ModelFactors) -> Any:
        varied: Any = super().vary_model(physics, factors)
        return varied.replace(starts=self.cube_positions(varied))

    def step_physics(self, physics: TowerPhysics, action: jax.Array) -> TowerPhysics:
        return self._with_stage(self._move(physics, action[:3], action[3]))

    def _with_stage(self, physics: TowerPhysics) -> TowerPhysics:
        """Returns the physics with `placed` brought up to date."""
        stays = physics.placed | self.are_left(physics)[MIDDLE]
        return physics.replace(placed=self.are_in_place(physics)[MIDDLE] & stays)

    def features(self, physics: TowerPhysics) -> jax.Array:
        cubes = self.cube_positions(physics)
        values = gripper_values(physics) | {
            "gap between the fingers": self.gap(physics),
            "hand holds a cube": self.holding(physics),
        }
        velocities = self.cube_velocities(physics)
        for role, name in enumerate(ROLES):
            values |= {
                f"{name} cube position less gripper position": cubes[role] - physics.gripper_position,
                f"{name} cube position": cubes[role],
                f"{name} cube velocity": velocities[role],
            }
        return self.features_layout.join(values)

    def goal_observation(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        return super().goal_observation(tower_goals.pursued_first(features, goal), goal)

    def achieved_goal(self, physics: TowerPhysics) -> jax.Array:
        cubes, left = self.cube_positions(physics), self.are_left(physics)
        present = jnp.arange(CUBES) == _role(physics)
        at_hand = jnp.linalg.norm(cubes - physics.gripper_position, axis=1) <= _AT_HAND
        displaced = (jnp.linalg.norm(cubes - physics.starts, axis=1) > MOVED) & (present | at_hand)
        chosen = jnp.argmax(jnp.where(displaced, 1 + present, 0))
        of_cube = goal_of(cubes[chosen], chosen, left[chosen])
        return jnp.where(displaced.any(), of_cube, goal_of(physics.gripper_position))

    def sample_goal(self, rng: jax.Array, physics: TowerPhysics) -> jax.Array:
        return self.placement(physics)

    def placement(self, physics: TowerPhysics) -> jax.Array:
        """Returns the goal of the present placement, `[goal_size]`."""
        role = _role(physics)
        return goal_of(self.places(physics)[role], role, left=True)

    def plan_goals(self, rng: jax.Array, physics: TowerPhysics, training_goals: jax.Array | bool) -> TowerPlan:
        kind_rng, whose_rng, position_rng = jax.random.split(rng, 3)
        kind = jnp.where(training_goals, jax.random.uniform(kind_rng), 1.0)  # 1 is neither a relay nor elsewhere
        whose = jax.random.randint(whose_rng, (), 0, CUBES + 1)
        anywhere = self.random_position(position_rng)
        position = jnp.where(whose < CUBES, anywhere.at[2].set(_ON_TABLE), anywhere)
        return TowerPlan(
            goal=goal_of(position, whose),
            elsewhere=(kind >= RELAYS) & (kind < RELAYS + ELSEWHERE),
            relay=kind < RELAYS,
        )

    def current_goal(self, plan: TowerPlan, physics: TowerPhysics, step: jax.Array | int) -> jax.Array:
        pursued = jnp.where(plan.relay, self._stage(physics), self.placement(physics))
        return jnp.where(plan.elsewhere, plan.goal, pursued)

    def _stage(self, physics: TowerPhysics) -> jax.Array:
        """Returns the goal of a relay, `[goal_size]`, by the state alone: a cube that slips is taken again."""
        role = _role(physics)
        cube, place = self.cube_positions(physics)[role], self.places(physics)[role]
        away, brought = relay(physics.gripper_position, cube, place)
        before = jnp.where(away, goal_of(cube), goal_of(brought, role))
        return jnp.where(self.are_in_place(physics)[role], goal_of(place, role, left=True), before)

    def move_target(self, state: State, position: jax.Array) -> State:
        """Puts the base down below `position`, and the middle on it if it was left there; see `GoalEnv`."""
        physics = state.pipeline_state
        moved = self._put(physics, BASE, jnp.asarray(position).at[2].set(_ON_TABLE))
        moved = _choose(physics.placed, self._put(moved, MIDDLE, self.places(moved)[MIDDLE]), moved)
        return self._advance(state, moved, state.info["plan"], state.info["step"])

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        return tower_goals.goal_kind(goal)

    def success(self, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        alike = jnp.all(achieved[..., 3:] == desired[..., 3:], axis=-1)
        return tower_goals.is_at(achieved[..., :3], desired, self.success_threshold) & alike

    def goal_test(self, features: jax.Array, achieved: jax.Array, goal: jax.Array) -> jax.Array:
        """Tests position and hand alone, whether a cube has moved or not; see `GoalEnv`."""
        at_goal = tower_goals.is_at(tower_goals.position_of(features, goal), goal, self.success_threshold)
        return at_goal & tower_goals.is_left_as_wanted(features, goal)

    def goal_tolerance(self, goal: jax.Array) -> jax.Array:
        return jnp.where(
            tower_goals.is_to_be_left(goal)[..., None], place_tolerance(goal), super().goal_tolerance(goal)
        )

    def already_solved(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns whether goals are a cube's and within 3 cm of its present position, and it is left as wanted."""
        distance = jnp.linalg.norm(tower_goals.position_of(features, goal) - goal[..., :3], axis=-1)
        return ~tower_goals.is_of_gripper(goal) & (distance <= AT_GOAL) & tower_goals.is_left_as_wanted(features, goal)

    def lift_test_action(self, action: jax.Array) -> jax.Array:
        return jnp.array([0.0, 0.0, 0.0, 1.0])  # still and open

    def outcome(self, end: State, lifted: State) -> EpisodeMetrics:
        last = end.pipeline_state
        achieved = self.are_left(last)[TOP] & self.stands(last)
        success = achieved & self.stands(lifted.pipeline_state)
        cubes = self.cube_positions(last)
        place = cubes[BASE].at[2].add(2 * CUBE_WIDTH * self.object_factor(last))
        return self.measure(cubes[TOP], place, achieved, success)

    def stands(self, physics: TowerPhysics) -> jax.Array:
        """Returns whether the tower stands where the base started, wherever the hand is: a boolean `[]`."""
        shift = jnp.linalg.norm(self.cube_positions(physics)[BASE] - physics.starts[BASE])
        return (self.are_in_place(physics) & self.touching(physics)).all() & (shift <= _MOST_SHIFT)


def _role(physics: TowerPhysics) -> jax.Array:
    """Returns the role of the cube of the present placement, `[]`."""
    return jnp.where(physics.placed, TOP, MIDDLE)


def _choose(condition: jax.Array, one: Any, other: Any) -> Any:
    """Returns one of two physics of the same structure."""
    return jax.tree.map(lambda first, second: jnp.where(condition, first, second), one, other)

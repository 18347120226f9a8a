"""A tower of three cubes, put on one another in an order that differs from episode to episode."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from hgail_envs.base import EpisodeMetrics, State
from hgail_envs.layout import Layout, flag
from hgail_envs.tasks import controllers
from hgail_envs.tasks.base import CONTROL_PERIOD, ArmPhysics
from hgail_envs.tasks.cubes import OF_GRIPPER, CubeGoals, is_in_place
from hgail_envs.tasks.grasp import CUBE_WIDTH, holds
from hgail_envs.tasks.layouts import GAP, GRIPPER, TARGET, gripper_values, of_object, target_of
from hgail_envs.tasks.objects import MOVED
from hgail_envs.tasks.pick_and_place import draw_kind
from hgail_envs.variation import ModelFactors

TOP, MIDDLE, BASE = range(3)
"""Roles of the cubes, in the order of the features."""
NAMES = ("top cube", "middle cube", "base cube")
"""Their names."""
CUBES = len(NAMES)

_RANGE = 0.15  # metres around the gripper's start, along x and y, in which the cubes start
_ON_TABLE = 0.425  # metres, of a cube's centre
_AT_HAND = 0.15  # metres between gripper and cube, within which this holds for the cubes of other stages
_PADS = 2 * CUBES  # number of the first sensors, of the pads' contacts with each cube
_MOST_SHIFT = 0.05  # metres of the base cube from its start after a success
_BEGUN = 0.5  # fraction of the training episodes that start with the middle cube on the base
_RAISED = 0.45  # metres of height; on the table a cube's centre is at 0.425, on another cube at 0.475
_KIND_ON_TABLE, _KIND_OF_MIDDLE, _KIND_OF_TOP = 1, 3, 5  # one higher if the cube is left


def _features(first: str, second: str, third: str) -> Layout:
    hand = Layout(GAP, flag("hand holds a cube"))
    return GRIPPER + of_object(first) + of_object(second) + of_object(third) + hand


class TowerPhysics(ArmPhysics, kw_only=True):
    """`ArmPhysics`, the order of the cubes, their starts, and whether the first placement is done."""

    order: jax.Array
    """`[3]` integers: which of the scene's cubes a, b and c is the top, the middle and the base."""
    starts: jax.Array
    """`[3, 3]`: starts of the top, the middle and the base, metres."""
    placed: jax.Array
    """`[]` boolean: whether the middle cube was left in its place on the base, and has not come out of it since."""


class TowerPlan(struct.PyTreeNode):
    """The goals of an episode of `Tower`."""

    goal: jax.Array
    """`[goal_size]`: pursued where `elsewhere`."""
    elsewhere: jax.Array
    """`[]` boolean: whether the goal is `goal`."""
    relay: jax.Array
    """`[]` boolean: whether the goals are the stages on the way to a placement."""


class Tower(CubeGoals):
    """A tower of three: put the middle cube on the base, and the top cube on it, and withdraw the hand.

    Start, success, achieved goals and training goals are in `docs/tasks.md`; see `CubeGoals` for what a goal is, and
    `ArmEnv` for the arguments.

    Each episode draws at random which of the three coloured cubes is the top, the middle and the base. Observation and
    goals speak of these roles alone, so a policy sees the order of the tower in the order of its numbers. In the
    observation the target's cube is first, then the one that it is to lie on, then the third, so that one placement
    looks to the policy like the other. In the features, and under goals of the gripper, the top is first.

    The goal names one placement after the other: the middle cube left on the base, and as soon as it was left there and
    as long as it stays there, the top cube left on the middle. The place is where the cube below now is.
    """

    episode_length = 200  # a scripted hand with a noise of .1 reaches half of the goals in 100, .9 in 200
    features_layout = _features(*NAMES)
    seen_layout = _features("target's cube", "cube below it", "third cube")
    cubes, cubes_to_leave = NAMES, CUBES
    flags = tuple(f"target is the {cube}'s" for cube in NAMES)
    left_flag = "the cube is to be left at the target"
    goal_layout = Layout(TARGET, *map(flag, (*flags, left_flag)))
    goal_kinds = 7

    scene = "tower"
    instruction = "Build a tower of three cubes."
    controllers = (seen_layout + goal_layout).readers({"from-above": controllers.tower})

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
        return self.is_left(apart, self.cube_velocities(physics), self.gap(physics))

    def holding(self, physics: TowerPhysics) -> jax.Array:
        """Returns whether both pads touch one of the cubes and stand as far apart as it is wide, a boolean `[]`."""
        touching = (physics.sensordata[:_PADS].reshape(CUBES, 2) > 0).all(axis=1).any()
        return holds(self, physics, touching)

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
        for role, cube in enumerate(NAMES):
            values |= {
                f"{cube} position less gripper position": cubes[role] - physics.gripper_position,
                f"{cube} position": cubes[role],
                f"{cube} velocity": velocities[role],
            }
        return self.features_layout.join(values)

    def goal_observation(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        # The pursued cube comes first, then the one that it is to lie on: the roles are turned.
        turned = (jnp.argmax(self.whose(goal), axis=-1)[..., None] + jnp.arange(CUBES)) % CUBES
        of_cubes = self.features_layout.span("top cube position less gripper position", "base cube velocity")
        by_role = features[..., of_cubes].reshape(*features.shape[:-1], CUBES, -1)
        cubes = jnp.take_along_axis(by_role, turned[..., None], axis=-2).reshape(*features.shape[:-1], -1)
        before, after = features[..., : of_cubes.start], features[..., of_cubes.stop :]
        return super().goal_observation(jnp.concatenate([before, cubes, after], axis=-1), goal)

    def achieved_goal(self, physics: TowerPhysics) -> jax.Array:
        cubes, left = self.cube_positions(physics), self.are_left(physics)
        present = jnp.arange(CUBES) == _role(physics)
        at_hand = jnp.linalg.norm(cubes - physics.gripper_position, axis=1) <= _AT_HAND
        displaced = (jnp.linalg.norm(cubes - physics.starts, axis=1) > MOVED) & (present | at_hand)
        chosen = jnp.argmax(jnp.where(displaced, 1 + present, 0))
        of_cube = self.goal_of(cubes[chosen], chosen, left[chosen])
        return jnp.where(displaced.any(), of_cube, self.goal_of(physics.gripper_position, OF_GRIPPER))

    def sample_goal(self, rng: jax.Array, physics: TowerPhysics) -> jax.Array:
        return self.placement(physics)

    def placement(self, physics: TowerPhysics) -> jax.Array:
        """Returns the goal of the present placement, `[goal_size]`."""
        role = _role(physics)
        return self.goal_of(self.places(physics)[role], role, left=True)

    def plan_goals(self, rng: jax.Array, physics: TowerPhysics, training_goals: jax.Array | bool) -> TowerPlan:
        kind_rng, whose_rng, position_rng = jax.random.split(rng, 3)
        relay, elsewhere = draw_kind(kind_rng, training_goals)
        whose = jax.random.randint(whose_rng, (), 0, CUBES + 1)  # the last is the gripper
        anywhere = self.random_position(position_rng)
        position = jnp.where(whose < CUBES, anywhere.at[2].set(_ON_TABLE), anywhere)
        return TowerPlan(goal=self.goal_of(position, whose), elsewhere=elsewhere, relay=relay)

    def current_goal(self, plan: TowerPlan, physics: TowerPhysics, step: jax.Array | int) -> jax.Array:
        role = _role(physics)
        stage = self.stage(physics, role, self.cube_positions(physics)[role], self.places(physics)[role])
        return jnp.where(plan.elsewhere, plan.goal, jnp.where(plan.relay, stage, self.placement(physics)))

    def move_target(self, state: State, position: jax.Array) -> State:
        """Puts the base down below `position`, and the middle on it if it was left there; see `GoalEnv`."""
        physics = state.pipeline_state
        moved = self._put(physics, BASE, jnp.asarray(position).at[2].set(_ON_TABLE))
        moved = _choose(physics.placed, self._put(moved, MIDDLE, self.places(moved)[MIDDLE]), moved)
        return self._advance(state, moved, state.info["plan"], state.info["step"])

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        """Returns 0 for goals of the gripper, 1 of a cube on the table, 3 of the middle and 5 of the top above it.

        Those of a cube that is left are one higher. The base counts as on the table wherever it is.
        """
        whose = self.whose(goal)
        raised = (target_of(goal)[..., 2] > _RAISED) & ~whose[..., BASE]
        of_cube = jnp.where(raised, jnp.where(whose[..., TOP], _KIND_OF_TOP, _KIND_OF_MIDDLE), _KIND_ON_TABLE)
        return jnp.where(whose.any(axis=-1), of_cube + self.is_to_be_left(goal), 0)

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
    return jax.tree.map(lambda first, second: jnp.where(condition, first, second), one, other)

"""Grasping a cube from the table, with three meanings of a goal."""

import functools
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from hgail_envs.base import Controller, EpisodeMetrics, State
from hgail_envs.fetch import controllers
from hgail_envs.fetch.arm import REFERENCE_SUBSTEPS, FetchEnv, FetchPhysics
from hgail_envs.validation import check_name

CUBES = ("at-start", "tracked")
"""Values of `cube`."""
TRACKED_SIZE = 11
"""Numbers of a tracked cube's observation without the goal."""
CUBE_WIDTH = 0.05
"""Metres along each edge."""
WIDEST_GAP = 0.1
"""Metres between the fingers of an open hand."""

CUBE_RANGE = 0.15
"""Metres around the gripper's start, along x and y, in which the cube starts."""
LEAST_RISE = 0.05
"""Least rise of a held cube in the lift test, metres."""

_GAP_TOLERANCE = 0.008  # metres; C MuJoCo squeezes the pads 2 to 5 mm into the cube
_CUBE_HEIGHT = 0.425  # metres, on the table


def is_held(touching: Any, gap: Any, width: Any = CUBE_WIDTH) -> Any:
    """Returns whether a hand holds the cube.

    Args:
      touching: boolean, or an array of them: both pads touch the cube.
      gap: metres between the fingers, a number or an array as large.
      width: metres, of the cube.

    """
    return touching & (abs(gap - width) <= _GAP_TOLERANCE)


class Grasp(FetchEnv):
    """Grasping the cube of FetchPickAndPlace; a goal is a position and whether the cube is held there.

    | index | quantity | unit |
    |---|---|---|
    | 0:3 | gripper position | m |
    | 3:6 | gripper velocity × 0.04 s | m |
    | 6 | gap between the fingers | m |
    | 7 | holding: both pads touch the cube, and the gap is its width within 8 mm | 0 or 1 |
    | 8:11 | target position | m |
    | 11 | whether to hold the cube there | 0 or 1 |

    The first eleven without 6 and 7 are the paper's observation. The paper's goal is a position alone, independent of
    the hand: see `GraspPosition`. Here hindsight relabels a step with the position and the holding of a later one, so
    that the expert samples of a goal with holding 1 are real grasps.

    An episode starts as the reference's FetchPickAndPlace-v4 does: hand closed, the cube uniform within ±0.15 m of
    the gripper in x and y and at least 0.10 m away. The evaluation's goal is (cube, 1). Half the training goals are
    (a random position, 0).

    Success is strict, and includes a lift test. After the last step both pads touch the cube and the gap is its width
    within 8 mm, and in twelve further steps straight up, with the gripper command held, the cube rises by more than
    5 cm. `achieved` of the metrics is without that test. Distances are between gripper and cube after the last step.

    A policy is told where the cube was at the start, as by one look of a camera: if a finger pushes it away, the policy
    does not know. With `cube="tracked"`, which TD3 takes by default, it is told at each step where the cube is, so that
    it can try again: 8:11 are the cube's position less the gripper's, metres, the target and whether to hold have
    11:15, and the target of a goal with holding 1 follows the cube.

    See `FetchEnv` for the other arguments.

    Args:
      cube: `"at-start"` or `"tracked"`, what a policy is told of the cube.

    Raises:
      ValueError: an unknown option.

    """

    feature_size = 8
    goal_size = 4
    goal_kinds = 2
    lift_test_steps = 12

    scene = "fetch/grasp"
    target_body = "cube"
    reference = "FetchPickAndPlace-v4"
    controllers: ClassVar[Mapping[str, Controller]] = {
        "from-above": controllers.grasp,
        "straight": controllers.straight,
        "closed": controllers.closed,
    }

    def __init__(
        self, impl: str = "auto", substeps: int = REFERENCE_SUBSTEPS, worlds: int = 4096, cube: str = CUBES[0]
    ) -> None:
        check_name("cube", cube, CUBES)
        self.cube = cube
        if cube == "tracked":
            self.feature_size = TRACKED_SIZE
            self.controllers = {  # type: ignore[misc]
                name: functools.partial(_act_untold, act) for name, act in self.controllers.items()
            }
        super().__init__(impl, substeps, worlds)
        self._cube_qpos = int(self.model.joint("cube").qposadr[0])
        self._cube_qvel = int(self.model.joint("cube").dofadr[0])

    def holding(self, physics: FetchPhysics) -> jax.Array:
        """Returns whether both pads touch the cube and stand as far apart as it is wide, a boolean `[]`."""
        width = CUBE_WIDTH * self.object_factor(physics)
        return is_held(jnp.all(physics.sensordata > 0), self.gap(physics), width)

    def cube_position(self, physics: FetchPhysics) -> jax.Array:
        """Returns the cube's centre, `[3]`, metres, world frame."""
        return physics.qpos[self._cube_qpos : self._cube_qpos + 3]

    def reset_physics(self, rng: jax.Array) -> FetchPhysics:
        cube = jnp.append(self.random_place(rng, CUBE_RANGE), _CUBE_HEIGHT)
        physics = super().reset_physics(rng)
        return physics.replace(qpos=physics.qpos.at[self._cube_qpos : self._cube_qpos + 3].set(cube))

    def step_physics(self, physics: FetchPhysics, action: jax.Array) -> FetchPhysics:
        return self._move(physics, action[:3], action[3])

    def features(self, physics: FetchPhysics) -> jax.Array:
        hand = jnp.array([self.gap(physics), self.holding(physics)], jnp.float32)
        gripper = physics.gripper_position
        cube = self.cube_position(physics) - gripper if self.cube == "tracked" else jnp.zeros(0)
        return jnp.concatenate([gripper, physics.gripper_velocity, hand, cube])

    def achieved_goal(self, physics: FetchPhysics) -> jax.Array:
        return jnp.append(physics.gripper_position, self.holding(physics).astype(jnp.float32))

    def sample_goal(self, rng: jax.Array, physics: FetchPhysics) -> jax.Array:
        return jnp.append(self.cube_position(physics), 1.0)

    def plan_goals(self, rng: jax.Array, physics: FetchPhysics, training_goals: jax.Array | bool) -> jax.Array:
        kind_rng, position_rng, goal_rng = jax.random.split(rng, 3)
        elsewhere = jnp.append(self.random_position(position_rng), 0.0)
        away = training_goals & jax.random.bernoulli(kind_rng)
        return jnp.where(away, elsewhere, self.sample_goal(goal_rng, physics))

    def current_goal(self, plan: jax.Array, physics: FetchPhysics, step: jax.Array | int) -> jax.Array:
        """Returns the plan, a goal, or where the cube is if it is tracked and to be held; see `GoalEnv`."""
        if self.cube == "at-start":
            return plan
        at_cube = self.sample_goal(jax.random.key(0), physics)  # it draws nothing
        return jnp.where(self.goal_kind(plan) == 1, at_cube, plan)

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        return (goal[..., 3] > 0.5).astype(jnp.int32)

    def success(self, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        # Both ways: a goal with holding 0 is not achieved by a hand that holds the cube.
        return super().success(achieved[..., :3], desired[..., :3]) & (achieved[..., 3] == desired[..., 3])

    def move_target(self, state: State, position: jax.Array) -> State:
        """Puts the cube down at `position`, at rest and upright, and makes it the goal; see `GoalEnv`."""
        physics = state.pipeline_state
        pose = jnp.concatenate([position, jnp.array([1.0, 0.0, 0.0, 0.0])])
        moved = physics.replace(
            qpos=jax.lax.dynamic_update_slice(physics.qpos, pose, (self._cube_qpos,)),
            qvel=jax.lax.dynamic_update_slice(physics.qvel, jnp.zeros(6), (self._cube_qvel,)),
            sensordata=jnp.zeros_like(physics.sensordata),  # the pads no longer touch it
        )
        # The evaluation's plan follows from the cube alone, so that any key will do.
        plan = self.plan_goals(jax.random.key(0), moved, training_goals=False)
        return self._advance(state, moved, plan, state.info["step"])

    def lift_test_action(self, action: jax.Array) -> jax.Array:
        return jnp.array([0.0, 0.0, 1.0, 0.0]).at[3].set(action[3])

    def outcome(self, end: State, lifted: State) -> EpisodeMetrics:
        last, lifted = end.pipeline_state, lifted.pipeline_state
        held = self.holding(last)
        # Contact and gap alone do not prove a grasp: only a cube that is held rises.
        rise = self.cube_position(lifted)[2] - self.cube_position(last)[2]
        return self.measure(last.gripper_position, self.cube_position(last)).replace(
            success=(held & (rise > LEAST_RISE)).astype(jnp.float32), achieved=held.astype(jnp.float32)
        )


def _act_untold(controller: Controller, observation: jax.Array) -> jax.Array:
    """Returns a controller's action on a tracked cube's observation, of which it reads all but the cube's position."""
    return controller(jnp.concatenate([observation[..., : Grasp.feature_size], observation[..., TRACKED_SIZE:]], -1))


class GraspPosition(Grasp):
    """Grasping by the paper's literal reading: a goal is a position, achieved by the gripper and desired of the cube.

    Observation: indices 0 to 10 of `Grasp`. Given the motion, the gripper command is independent of a relabelled goal,
    so neither the discriminator nor maximum likelihood can teach the hand; published as a negative result.
    """

    goal_size = 3
    goal_kinds = 1

    def __init__(self, impl: str = "auto", substeps: int = REFERENCE_SUBSTEPS, worlds: int = 4096) -> None:
        super().__init__(impl, substeps, worlds)

    def achieved_goal(self, physics: FetchPhysics) -> jax.Array:
        return physics.gripper_position

    def sample_goal(self, rng: jax.Array, physics: FetchPhysics) -> jax.Array:
        return self.cube_position(physics)

    def plan_goals(self, rng: jax.Array, physics: FetchPhysics, training_goals: jax.Array | bool) -> jax.Array:
        return self.sample_goal(rng, physics)

    # `Grasp`'s own versions of these read a fourth number that these goals do not have.
    def goal_kind(self, goal: jax.Array) -> jax.Array:
        return FetchEnv.goal_kind(self, goal)

    def success(self, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        return FetchEnv.success(self, achieved, desired)


class GraspAperture(Grasp):
    """Grasping with goals of a gripper position and a gap between the fingers; an evaluation follows a fixed plan.

    Observation: indices 0 to 10 of `Grasp` and, at 11, the desired gap in metres. Training goals are random. The
    evaluation's plan is: 10 cm above the cube with an open hand, at the cube with an open hand, at the cube with a
    closed one. So the control of the arm and the hand is learnt, while the order of a grasp is given.
    """

    goal_kinds = 1
    controllers: ClassVar[Mapping[str, Controller]] = {}

    _ABOVE = 0.1  # metres
    _DESCEND, _CLOSE = 18, 36  # steps at which the plan's next stage begins

    def __init__(self, impl: str = "auto", substeps: int = REFERENCE_SUBSTEPS, worlds: int = 4096) -> None:
        super().__init__(impl, substeps, worlds)

    def achieved_goal(self, physics: FetchPhysics) -> jax.Array:
        return jnp.append(physics.gripper_position, self.gap(physics))

    def sample_goal(self, rng: jax.Array, physics: FetchPhysics) -> jax.Array:
        return self._test_plan(physics)[-1]

    def plan_goals(self, rng: jax.Array, physics: FetchPhysics, training_goals: jax.Array | bool) -> jax.Array:
        """Returns the goals of the plan's stages, `[3, goal_size]`; the training goals are one random goal thrice."""
        position_rng, gap_rng = jax.random.split(rng)
        gap = jax.random.uniform(gap_rng, maxval=self.widest_gap(physics))
        anywhere = jnp.append(self.random_position(position_rng), gap)
        return jnp.where(training_goals, anywhere, self._test_plan(physics))

    def current_goal(self, plan: jax.Array, physics: FetchPhysics, step: jax.Array | int) -> jax.Array:
        return plan[jnp.sum(step >= jnp.array([self._DESCEND, self._CLOSE]))]

    def _test_plan(self, physics: FetchPhysics) -> jax.Array:
        (x, y, _), widest = self.cube_position(physics), self.widest_gap(physics)
        return jnp.array(
            [
                [x, y, _CUBE_HEIGHT + self._ABOVE, widest],
                [x, y, _CUBE_HEIGHT, widest],
                [x, y, _CUBE_HEIGHT, 0.0],
            ]
        )

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        return FetchEnv.goal_kind(self, goal)

    def success(self, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        at = FetchEnv.success(self, achieved[..., :3], desired[..., :3])
        return at & (jnp.abs(achieved[..., 3] - desired[..., 3]) <= _GAP_TOLERANCE)

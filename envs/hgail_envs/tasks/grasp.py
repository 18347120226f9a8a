"""Grasping a cube from the table."""

from typing import Any

import jax
import jax.numpy as jnp

from hgail_envs.base import EpisodeMetrics, State
from hgail_envs.layout import Layout, flag, position
from hgail_envs.tasks import controllers
from hgail_envs.tasks.base import ArmEnv, ArmPhysics
from hgail_envs.tasks.layouts import GRIPPER, HAND, TARGET, gripper_values
from hgail_envs.validation import check_name

CUBES = ("at-start", "tracked")
"""Values of `cube`."""
CUBE_WIDTH = 0.05
"""Metres along each edge."""

CUBE_RANGE = 0.15
"""Metres around the gripper's start, along x and y, in which the cube starts."""
LEAST_RISE = 0.05
"""Least height of a held cube above its start after the lift test, metres."""
HOLD = "to hold the cube at the target"
"""Name of the flag in a goal."""
GOAL = Layout(TARGET, flag(HOLD))
"""Layout of a goal."""

_CONTROLLERS = {"from-above": controllers.grasp, "straight": controllers.straight, "closed": controllers.closed}
_APART = "cube position less gripper position"  # of a tracked cube
_GAP_TOLERANCE = 0.008  # metres; C MuJoCo squeezes the pads 2 to 5 mm into the cube
_CUBE_HEIGHT = 0.425  # metres, on the table


def is_held(touching: Any, gap: Any, width: Any = CUBE_WIDTH, narrowest: Any = None) -> Any:
    """Returns whether a hand holds the cube: both pads touch it, and their `gap` is its `width` within 8 mm, metres.

    Pads that have turned in their fingers have the gap at their middles and are as close as `narrowest` elsewhere; the
    width may be anywhere between the two, which differ by 16 mm at most: a cube that is wedged between pads which have
    turned further slips out when it is lifted.
    """
    narrowest = gap if narrowest is None else narrowest
    is_between = (gap - width >= -_GAP_TOLERANCE) & (narrowest - width <= _GAP_TOLERANCE)
    return touching & is_between & (gap - narrowest <= 2 * _GAP_TOLERANCE)


def holds(env: ArmEnv, physics: ArmPhysics, touching: jax.Array) -> jax.Array:
    """Returns whether the hand holds a cube that both of its pads are `touching`, see `is_held`: a boolean `[]`."""
    width = CUBE_WIDTH * env.object_factor(physics)
    return is_held(touching, env.gap(physics), width, env.robot.narrowest_gap(physics.qpos))


class Grasp(ArmEnv):
    """Grasping the cube of FetchPickAndPlace; a goal is a position and whether the cube is held there.

    Start, success with its lift test, and goals are in `docs/tasks.md`; see `is_held` for when the hand holds the cube,
    and `ArmEnv` for the other arguments.

    The paper's observation has neither gap nor holding, and its goal is a position alone. Here hindsight relabels a
    step with the position and the holding of a later one, so that the expert samples of a goal with holding 1 are real
    grasps.

    With `cube="at-start"` a policy sees where the cube was at the start, as by one look of a camera: if a finger pushes
    it away, the policy does not know. With `cube="tracked"`, which TD3 takes by default, it sees at each step where the
    cube is, so that it can try again: the cube's position less the gripper's is the last of the features, and the
    target of a goal with holding 1 follows the cube.
    """

    features_layout = GRIPPER + HAND
    goal_layout = GOAL
    goal_kinds = 2
    lift_test_steps = 12

    scene = "grasp"
    instruction = "Grasp the cube."
    target_body = "cube"
    shows_goal = True
    reference = "FetchPickAndPlace-v4"
    controllers = (features_layout + goal_layout).readers(_CONTROLLERS)

    def __init__(self, *args: Any, cube: str = CUBES[0], **kwargs: Any) -> None:
        self.features_layout = self.features_with(cube=cube)
        self.feature_size = self.features_layout.size
        self.cube = cube
        if cube == "tracked":
            self.controllers = (self.features_layout + GOAL).readers(_CONTROLLERS)  # type: ignore[misc]
        super().__init__(*args, **kwargs)

    @classmethod
    def features_with(cls, **options: Any) -> Layout:
        cube = options.get("cube", CUBES[0])
        check_name("cube", cube, CUBES)
        return cls.features_layout + (Layout(position(_APART)) if cube == "tracked" else Layout())

    def holding(self, physics: ArmPhysics) -> jax.Array:
        """Returns whether the hand holds the cube, a boolean `[]`."""
        return holds(self, physics, jnp.all(physics.sensordata > 0))

    def cube_position(self, physics: ArmPhysics) -> jax.Array:
        """Returns the cube's centre, `[3]`, metres, world frame."""
        return physics.qpos[self.qpos_of("cube")]

    def reset_physics(self, rng: jax.Array) -> ArmPhysics:
        cube = jnp.append(self.random_place(rng, CUBE_RANGE), _CUBE_HEIGHT)
        physics = super().reset_physics(rng)
        return physics.replace(qpos=physics.qpos.at[self.qpos_of("cube")].set(cube))

    def step_physics(self, physics: ArmPhysics, action: jax.Array) -> ArmPhysics:
        return self._move(physics, action[:3], action[3])

    def features(self, physics: ArmPhysics) -> jax.Array:
        hand = {"gap between the fingers": self.gap(physics), "hand holds the cube": self.holding(physics)}
        apart = self.cube_position(physics) - physics.gripper_position
        tracked = {_APART: apart} if self.cube == "tracked" else {}
        return self.features_layout.join(gripper_values(physics) | hand | tracked)

    def achieved_goal(self, physics: ArmPhysics) -> jax.Array:
        return jnp.append(physics.gripper_position, self.holding(physics).astype(jnp.float32))

    def sample_goal(self, rng: jax.Array, physics: ArmPhysics) -> jax.Array:
        return jnp.append(self.cube_position(physics), 1.0)

    def plan_goals(self, rng: jax.Array, physics: ArmPhysics, training_goals: jax.Array | bool) -> jax.Array:
        kind_rng, position_rng, goal_rng = jax.random.split(rng, 3)
        elsewhere = jnp.append(self.random_position(position_rng), 0.0)
        away = training_goals & jax.random.bernoulli(kind_rng)
        return jnp.where(away, elsewhere, self.sample_goal(goal_rng, physics))

    def current_goal(self, plan: jax.Array, physics: ArmPhysics, step: jax.Array | int) -> jax.Array:
        """Returns the plan, a goal, or where the cube is if it is tracked and to be held; see `GoalEnv`."""
        if self.cube == "at-start":
            return plan
        at_cube = self.sample_goal(jax.random.key(0), physics)  # it draws nothing
        return jnp.where(self.goal_kind(plan) == 1, at_cube, plan)

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        return (goal[..., self.goal_layout[HOLD]] > 0.5).astype(jnp.int32)

    def move_target(self, state: State, position: jax.Array) -> State:
        """Puts the cube down at `position`, at rest and upright, and makes it the goal; see `GoalEnv`."""
        moved = self.put_down(state.pipeline_state, "cube", position)
        moved = moved.replace(sensordata=jnp.zeros_like(moved.sensordata))  # the pads no longer touch it
        # The evaluation's plan follows from the cube alone, so that any key will do.
        plan = self.plan_goals(jax.random.key(0), moved, training_goals=False)
        return self._advance(state, moved, plan, state.info["step"])

    def lift_test_action(self, action: jax.Array) -> jax.Array:
        return jnp.array([0.0, 0.0, 1.0, 0.0]).at[3].set(action[3])

    def outcome(self, end: State, lifted: State) -> EpisodeMetrics:
        last, lifted = end.pipeline_state, lifted.pipeline_state
        held = self.holding(last)
        # Contact and gap alone do not prove a grasp: only a cube that is held is above the table after it. One that is
        # as high as the arm reaches rises no more.
        success = held & (self.cube_position(lifted)[2] - _CUBE_HEIGHT > LEAST_RISE)
        return self.measure(last.gripper_position, self.cube_position(last), held, success)

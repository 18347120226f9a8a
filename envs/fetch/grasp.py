"""Grasping a cube from the table, under three readings of what a goal is."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from envs.base import Controller, EpisodeMetrics, State, TrainingDefaults
from envs.fetch import controllers
from envs.fetch.arm import ACCURATE_SUBSTEPS, FetchEnv, FetchPhysics

CUBE_WIDTH = 0.05
"""Metres along each edge."""
WIDEST_GAP = 0.1
"""Metres between the fingers of an open hand."""

CUBE_RANGE = 0.15
"""Metres around the gripper's start, along x and y, in which the cube starts."""
LEAST_DISTANCE = 0.1
"""Metres from the gripper's start, in the plane, at which the cube starts at least."""
LEAST_RISE = 0.05
"""Metres that a cube rises in the probe if it is held."""

_GAP_TOLERANCE = 0.008  # metres; C MuJoCo squeezes the pads 2 to 5 mm into the cube
_CANDIDATES = 32  # positions drawn to find one far enough; each is with probability 0.65
_CUBE_HEIGHT = 0.425  # metres, on the table
_GOAL_RANGE = 0.15  # metres around the gripper's start, of goals that are not the cube
_LOWEST_GOAL = 0.42  # metres; the pads rest on the table at 0.417


def is_held(touching: Any, gap: Any) -> Any:
    """Returns whether a hand holds the cube.

    Args:
      touching: boolean, or an array of them: both pads touch the cube.
      gap: metres between the fingers, a number or an array as large.

    """
    return touching & (abs(gap - CUBE_WIDTH) <= _GAP_TOLERANCE)


def _training(num_envs: int, rounds: int) -> TrainingDefaults:
    # A grasp is found by chance, so it takes wide roll-outs and many rounds; the likelihood of expert samples beside
    # PPO teaches the hand, and a wide deviation of its command alone finds the order of opening and closing.
    return TrainingDefaults(
        config={
            "num_envs": num_envs,
            "rounds": rounds,
            "policy_phases": 4,
            "discriminator_phases": 1,
            "ppo_minibatches": 16,
            "likelihood_batch": 2048,
            "discriminator_batch": 1024,
            "pretrain_policy_batch": 1024,
        },
        hyperparameters={
            "action_std": (0.2, 0.2, 0.2, 0.5),
            "likelihood_weight": 0.3,
            "policy_learning_rate": 1e-3,
            "discriminator_learning_rate": 2e-4,
        },
        options={"substeps": 8},
    )


class Grasp(FetchEnv):
    """FetchPickAndPlace's cube, to be grasped; a goal is a position and whether the cube is held there.

    | index | quantity | unit |
    |---|---|---|
    | 0:3 | gripper position | m |
    | 3:6 | gripper velocity × 0.04 s | m |
    | 6 | gap between the fingers | m |
    | 7 | holding: both pads touch the cube, and the gap is its width within 8 mm | 0 or 1 |
    | 8:11 | target position | m |
    | 11 | whether to hold the cube there | 0 or 1 |

    The first eleven less 6 and 7 are the paper's observation. Its goal is a position alone, and a position says
    nothing of the hand: see `GraspPosition`. Here hindsight relabels a step with the position and the holding of a
    later one, so that what is imitated for a goal with holding 1 are real grasps.

    An episode starts as the reference's FetchPickAndPlace-v4 does: hand closed, the cube uniform within ±0.15 m of
    the gripper in x and y and at least 0.10 m away. It is measured on the goal (cube, 1). Half the goals to learn from
    (`exploring`) are (a random position, 0).

    Success is strict. After the last step both pads touch the cube and the gap is its width within 8 mm, and in twelve
    further steps straight up, with the gripper command held, the cube rises by more than 5 cm. `achieved` of the
    metrics is the first half alone. Distances are between gripper and cube, where it then is.

    See `FetchEnv` for the arguments.
    """

    feature_size = 8
    goal_size = 4
    goal_kinds = 2
    probe_length = 12

    scene = "fetch/grasp"
    target_body = "cube"
    reference = "FetchPickAndPlace-v4"
    controllers: ClassVar[Mapping[str, Controller]] = {
        "from-above": controllers.grasp,
        "straight": controllers.straight,
        "closed": controllers.closed,
    }
    training: ClassVar[Mapping[str, TrainingDefaults]] = {
        "cpu": _training(num_envs=1024, rounds=16),
        "gpu": _training(num_envs=1024, rounds=40),
    }

    def __init__(self, impl: str = "auto", substeps: int = ACCURATE_SUBSTEPS, worlds: int = 4096) -> None:
        super().__init__(impl, substeps, worlds)
        self._cube_qpos = int(self.model.joint("cube").qposadr[0])
        self._cube_qvel = int(self.model.joint("cube").dofadr[0])

    def gap(self, physics: FetchPhysics) -> jax.Array:
        """Returns the distance between the fingers, `[]`, metres."""
        return physics.qpos[self._finger_qpos].sum()

    def holding(self, physics: FetchPhysics) -> jax.Array:
        """Returns whether both pads touch the cube and stand as far apart as it is wide, a boolean `[]`."""
        return is_held(jnp.all(physics.sensordata > 0), self.gap(physics))

    def cube_position(self, physics: FetchPhysics) -> jax.Array:
        """Returns the cube's centre, `[3]`, metres, world frame."""
        return physics.qpos[self._cube_qpos : self._cube_qpos + 3]

    def reset_physics(self, rng: jax.Array) -> FetchPhysics:
        offsets = jax.random.uniform(rng, (_CANDIDATES, 2), minval=-CUBE_RANGE, maxval=CUBE_RANGE)
        far = jnp.linalg.norm(offsets, axis=-1) >= LEAST_DISTANCE
        cube = jnp.append(self.initial_gripper_position[:2] + offsets[jnp.argmax(far)], _CUBE_HEIGHT)
        qpos = self._initial_physics.qpos.at[self._cube_qpos : self._cube_qpos + 3].set(cube)
        return self._initial_physics.replace(qpos=qpos)

    def step_physics(self, physics: FetchPhysics, action: jax.Array) -> FetchPhysics:
        return self._move(physics, action[:3], action[3])

    def features(self, physics: FetchPhysics) -> jax.Array:
        hand = jnp.array([self.gap(physics), self.holding(physics)], jnp.float32)
        return jnp.concatenate([physics.gripper_position, physics.gripper_velocity, hand])

    def achieved_goal(self, physics: FetchPhysics) -> jax.Array:
        return jnp.append(physics.gripper_position, self.holding(physics).astype(jnp.float32))

    def sample_goal(self, rng: jax.Array, physics: FetchPhysics) -> jax.Array:
        return jnp.append(self.cube_position(physics), 1.0)

    def sample_exploration_goal(self, rng: jax.Array, physics: FetchPhysics) -> jax.Array:
        kind_rng, position_rng, goal_rng = jax.random.split(rng, 3)
        elsewhere = jnp.append(self._random_position(position_rng), 0.0)
        return jnp.where(jax.random.bernoulli(kind_rng), elsewhere, self.sample_goal(goal_rng, physics))

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        return (goal[..., 3] > 0.5).astype(jnp.int32)

    def success(self, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        return super().success(achieved[..., :3], desired[..., :3]) & (achieved[..., 3] == desired[..., 3])

    def move_target(self, state: State, position: jax.Array) -> State:
        """Puts the cube down at `position`, at rest and upright, and makes it the goal; see `GoalEnv`."""
        physics = state.pipeline_state
        pose = jnp.concatenate([position, jnp.array([1.0, 0.0, 0.0, 0.0])])
        moved = physics.replace(
            qpos=jax.lax.dynamic_update_slice(physics.qpos, pose, (self._cube_qpos,)),
            qvel=jax.lax.dynamic_update_slice(physics.qvel, jnp.zeros(6), (self._cube_qvel,)),
            sensordata=jnp.zeros_like(physics.sensordata),  # nothing touches it any more
        )
        goal = self.sample_goal(jax.random.key(0), moved)
        return self._retarget(state, moved, self.track_goal(goal, moved, exploring=False))

    def probe_action(self, action: jax.Array) -> jax.Array:
        return jnp.array([0.0, 0.0, 1.0, 0.0]).at[3].set(action[3])

    def outcome(self, end: State, probed: State) -> EpisodeMetrics:
        last, lifted = end.pipeline_state, probed.pipeline_state
        touched = self.holding(last)
        rise = self.cube_position(lifted)[2] - self.cube_position(last)[2]
        return self.measure(last.gripper_position, self.cube_position(last)).replace(
            success=(touched & (rise > LEAST_RISE)).astype(jnp.float32), achieved=touched.astype(jnp.float32)
        )

    def _random_position(self, rng: jax.Array) -> jax.Array:
        offset = jax.random.uniform(rng, (3,), minval=-_GOAL_RANGE, maxval=_GOAL_RANGE)
        position = self.initial_gripper_position + offset
        return position.at[2].max(_LOWEST_GOAL)


class GraspPosition(Grasp):
    """The paper's literal reading: a goal is a position, for hindsight the gripper's, in an episode the cube's.

    Observation: indices 0 to 10 of `Grasp`. Given the motion, the gripper command is independent of a relabelled goal,
    so neither the discriminator nor maximum likelihood can teach the hand; published as a negative result.
    """

    goal_size = 3
    goal_kinds = 1

    def achieved_goal(self, physics: FetchPhysics) -> jax.Array:
        return physics.gripper_position

    def sample_goal(self, rng: jax.Array, physics: FetchPhysics) -> jax.Array:
        return self.cube_position(physics)

    def sample_exploration_goal(self, rng: jax.Array, physics: FetchPhysics) -> jax.Array:
        return self.cube_position(physics)

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        return FetchEnv.goal_kind(self, goal)

    def success(self, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        return FetchEnv.success(self, achieved, desired)


class GraspAperture(Grasp):
    """A goal is a gripper position and a gap between the fingers; at test the goals follow a fixed plan.

    Observation: indices 0 to 10 of `Grasp` and, at 11, the desired gap in metres. Goals to learn from are random. The
    plan is: 10 cm above the cube with an open hand, at the cube with an open hand, at the cube with a closed one. So
    the control of the arm and the hand is learnt, while the order of a grasp is given.
    """

    goal_kinds = 1
    controllers: ClassVar[Mapping[str, Controller]] = {}

    _ABOVE = 0.1  # metres
    _DESCEND, _CLOSE = 18, 36  # steps at which the plan goes on

    def achieved_goal(self, physics: FetchPhysics) -> jax.Array:
        return jnp.append(physics.gripper_position, self.gap(physics))

    def sample_goal(self, rng: jax.Array, physics: FetchPhysics) -> jax.Array:
        return jnp.append(self.cube_position(physics), WIDEST_GAP)

    def sample_exploration_goal(self, rng: jax.Array, physics: FetchPhysics) -> jax.Array:
        position_rng, gap_rng = jax.random.split(rng)
        return jnp.append(self._random_position(position_rng), jax.random.uniform(gap_rng, maxval=WIDEST_GAP))

    def track_goal(self, desired: jax.Array, physics: FetchPhysics, exploring: jax.Array | bool) -> jax.Array:
        height = _CUBE_HEIGHT + jnp.where(physics.steps < self._DESCEND, self._ABOVE, 0.0)
        gap = jnp.where(physics.steps < self._CLOSE, WIDEST_GAP, 0.0)
        return jnp.where(exploring, desired, jnp.array([desired[0], desired[1], height, gap]))

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        return FetchEnv.goal_kind(self, goal)

    def success(self, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        at = FetchEnv.success(self, achieved[..., :3], desired[..., :3])
        return at & (jnp.abs(achieved[..., 3] - desired[..., 3]) <= _GAP_TOLERANCE)

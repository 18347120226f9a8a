"""Wraps a task so that each of its episodes is disturbed in its own way."""

import copy
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from hgail_envs.base import Controller, EpisodeMetrics, GoalEnv, State
from hgail_envs.randomization import LEVELS, MODEL_FACTORS, RAMPED, Randomization, Range
from hgail_envs.variation import ModelFactors, SensorErrors

_SOURCES = ("robot", "object", "goal")  # whose position is observed with an error
_ROBOT, _OBJECT, _GOAL = range(len(_SOURCES))
_SAME = (
    *("episode_length", "goal_size", "action_size", "success_threshold", "goal_kinds", "lift_test_steps"),
    *("observation_limit", "max_worlds", "control_period", "scene", "target_body", "reference", "training"),
    *("impl", "substeps"),
)
"""Attributes that a task has in common with its randomised one, where it has them."""


class Drawn(struct.PyTreeNode):
    """What an episode is disturbed by, besides its model and its start."""

    delay: jax.Array
    """`[]` integer: steps."""
    step_size: jax.Array
    """`[]`: factor on displacements."""
    z_bias: jax.Array
    """`[]`: share of a full displacement."""
    offset: jax.Array
    """`[3, 3]`: metres, in the observed positions of gripper, object and goal."""


class RandomizedPhysics(struct.PyTreeNode):
    """The task's physics state, and what stands between it and the policy."""

    true: Any
    """The task's own."""
    drawn: Drawn
    rng: jax.Array
    """`[2]` integers: the key of the noises to come."""
    noise: jax.Array
    """`[3, 3]`: metres, added at this step to the positions of gripper, object and goal that are observed."""
    noise_before: jax.Array
    """`[3, 3]`: likewise, at the step before."""
    pending: jax.Array
    """`[longest delay, action_size]`: the last actions, newest first."""
    history: jax.Array
    """`[history, action_size + features]`: the last actions and what was observed before each, newest first."""

    @property
    def qpos(self) -> jax.Array:
        """The true joint positions, of a task that has any."""
        return self.true.qpos

    @property
    def goal_error(self) -> jax.Array:
        """By how much the position in a goal is wrong at this step, `[3]`, metres."""
        return self.drawn.offset[_GOAL] + self.noise[_GOAL]

    def errors(self) -> SensorErrors:
        """Returns by how much gripper and object are observed wrongly at this step."""
        position, motion = self.drawn.offset + self.noise, self.noise - self.noise_before
        return SensorErrors(position[_ROBOT], motion[_ROBOT], position[_OBJECT], motion[_OBJECT])


class RandomizedEnv(GoalEnv):
    """A task of which each episode is disturbed in its own way, drawn with the episode's key at the reset.

    A policy acts late, its displacements are scaled, and it observes gripper, object and goal where they are not. The
    features are `history` of the last actions and observations, then the task's own. Goals are relabelled as they are
    observed: the position in an achieved goal has the same error as the one in the episode's desired goal, since the
    same camera sees both. Reward, success and distances are those of the true positions.

    An action begins with a displacement in x, y and z, and a goal with a position, as far as they have three numbers.

    Args:
      task: the task; its `add_sensor_noise`, `vary_model` and `vary_start` are needed where a size asks for them.
      randomization: the sizes.

    Raises:
      ValueError: the task lacks what a size asks for.

    """

    action_size = 0  # each instance has its task's

    def __init__(self, task: GoalEnv, randomization: Randomization) -> None:
        needed = {
            "add_sensor_noise": randomization.has_sensor_noise,
            "vary_model": randomization.varies_model,
            "vary_start": randomization.varies_start,
        }
        for method, is_needed in needed.items():
            if is_needed and getattr(type(task), method) is getattr(GoalEnv, method):
                raise ValueError(
                    f"{type(task).__name__} cannot be randomised so: it has no {method}; write it, or take a"
                    " randomisation that needs none"
                )
        self.task, self.randomization = task, randomization
        self._sizes = dict(vars(randomization))
        for name in _SAME:
            if hasattr(task, name):
                setattr(self, name, getattr(task, name))
        self._shown = randomization.history * (task.action_size + task.feature_size)
        self.feature_size = self._shown + task.feature_size
        self.controllers = {name: self._without_history(act) for name, act in task.controllers.items()}  # type: ignore[misc]

    def _without_history(self, controller: Controller) -> Controller:
        return lambda observation: controller(observation[..., self._shown :])

    def reset_physics(self, rng: jax.Array) -> RandomizedPhysics:
        """See `GoalEnv`."""
        sizes, task = self.randomization, self.task
        task_rng, start_rng, drawn_rng, offset_rng, noise_rng = jax.random.split(rng, 5)
        shares = jax.random.uniform(drawn_rng, (3 + len(MODEL_FACTORS),))  # all at once, which compiles the quickest
        true = task.reset_physics(task_rng)
        if sizes.varies_start:
            true = task.vary_start(start_rng, true, sizes.posture, self._sizes["hand_opening"])
        if sizes.varies_model:
            true = task.vary_model(true, self._factors(shares[3:]))
        physics = RandomizedPhysics(
            true=true,
            drawn=self._drawn(shares[:3], jax.random.normal(offset_rng, (3, 3))),
            rng=jax.random.key_data(noise_rng),
            noise=jnp.zeros((3, 3)),
            noise_before=jnp.zeros((3, 3)),
            pending=jnp.zeros((sizes.delay[1], task.action_size)),
            history=jnp.zeros((sizes.history, task.action_size + task.feature_size)),
        )
        physics = self._observe_anew(physics)
        physics = physics.replace(noise_before=physics.noise)  # nothing has moved
        first = jnp.concatenate([jnp.zeros(task.action_size), self._seen(physics)])
        return physics.replace(history=jnp.broadcast_to(first, physics.history.shape))

    def _factors(self, shares: jax.Array) -> ModelFactors:
        """Returns the factors at these shares of their ranges, in [0, 1)."""
        return ModelFactors(
            **{name: _between(self._sizes[name], share) for name, share in zip(MODEL_FACTORS, shares, strict=True)}
        )

    def _drawn(self, shares: jax.Array, offsets: jax.Array) -> Drawn:
        """Returns what is drawn: shares, `[3]` in [0, 1), of ranges, and offsets, `[3, 3]`, in deviations."""
        least, most = self._sizes["delay"]
        # Rounding may reach `most + 1`, which is no whole number while it grows.
        delay = jnp.minimum(jnp.floor(_between((least, most + 1), shares[0])), jnp.ceil(most))
        deviations = jnp.array([self._sizes[f"{source}_offset"] for source in _SOURCES])
        return Drawn(
            delay=delay.astype(jnp.int32),
            step_size=_between(self._sizes["step_size"], shares[1]),
            z_bias=_between(self._sizes["z_bias"], shares[2]),
            offset=deviations[:, None] * offsets,
        )

    def _observe_anew(self, physics: RandomizedPhysics) -> RandomizedPhysics:
        """Returns the physics with the noise of another step."""
        following_rng, rng = jax.random.split(jax.random.wrap_key_data(physics.rng))
        deviations = jnp.array([self._sizes[f"{source}_noise"] for source in _SOURCES])
        return physics.replace(
            rng=jax.random.key_data(following_rng),
            noise=deviations[:, None] * jax.random.normal(rng, (3, 3)),
            noise_before=physics.noise,
        )

    def step_physics(self, physics: RandomizedPhysics, action: jax.Array) -> RandomizedPhysics:
        """See `GoalEnv`; the task's own may be given displacements beyond [-1, 1]."""
        drawn, queue = physics.drawn, jnp.concatenate([action[None], physics.pending])
        shown = jnp.concatenate([action, self._seen(physics)])
        late, axes = queue[drawn.delay], min(3, self.action_size)
        late = late.at[:axes].multiply(drawn.step_size)
        if axes == 3:
            late = late.at[2].add(-drawn.z_bias)
        moved = physics.replace(
            true=self.task.step_physics(physics.true, late),
            pending=queue[: len(physics.pending)],
            history=jnp.concatenate([shown[None], physics.history])[: len(physics.history)],
        )
        return self._observe_anew(moved)

    def _seen(self, physics: RandomizedPhysics) -> jax.Array:
        """Returns the task's features as they are observed, `[feature_size]` of the task."""
        if not self.randomization.has_sensor_noise:
            return self.task.features(physics.true)
        return self.task.features(self.task.add_sensor_noise(physics.true, physics.errors()))

    def features(self, physics: RandomizedPhysics) -> jax.Array:
        """See `GoalEnv`: the history, then the task's features as they are observed."""
        return jnp.concatenate([physics.history.reshape(-1), self._seen(physics)])

    def goal_observation(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        """See `GoalEnv`: the history, then the task's own."""
        history, seen = features[..., : self._shown], features[..., self._shown :]
        return jnp.concatenate([history, self.task.goal_observation(seen, goal)], axis=-1)

    @property
    def observation_size(self) -> int:
        """Numbers in `State.obs`."""
        return self._shown + self.task.observation_size

    def achieved_goal(self, physics: RandomizedPhysics) -> jax.Array:
        """See `GoalEnv`; as it is observed."""
        return self._add(self.task.achieved_goal(physics.true), physics.goal_error)

    def sample_goal(self, rng: jax.Array, physics: RandomizedPhysics) -> jax.Array:
        """Draws the true goal, `[goal_size]`, which is not observed."""
        return self.task.sample_goal(rng, physics.true)

    def plan_goals(self, rng: jax.Array, physics: RandomizedPhysics, training_goals: jax.Array | bool) -> Any:
        """See `GoalEnv`; the plan has the true goals."""
        return self.task.plan_goals(rng, physics.true, training_goals)

    def current_goal(self, plan: Any, physics: RandomizedPhysics, step: jax.Array | int) -> jax.Array:
        """Returns the desired goal as it is observed, `[goal_size]`."""
        return self._add(self.task.current_goal(plan, physics.true, step), physics.goal_error)

    def _add(self, goal: jax.Array, error: jax.Array) -> jax.Array:
        """Returns a goal, `[goal_size]`, with an error in its position."""
        axes = min(3, self.goal_size)
        return goal.at[:axes].add(error[:axes])

    def success(self, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        """See `GoalEnv`."""
        return self.task.success(achieved, desired)

    def reached(self, physics: RandomizedPhysics, desired: jax.Array) -> jax.Array:
        """Returns whether `physics` truly is at the goal that is observed as `desired`: a boolean `[]`."""
        return self.task.reached(physics.true, self._add(desired, -physics.goal_error))

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        """See `GoalEnv`."""
        return self.task.goal_kind(goal)

    def goal_test(self, features: jax.Array, achieved: jax.Array, goal: jax.Array) -> jax.Array:
        """See `GoalEnv`; of the positions that are observed."""
        return self.task.goal_test(features[..., self._shown :], achieved, goal)

    def already_solved(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        """See `GoalEnv`, of what is observed."""
        return self.task.already_solved(features[..., self._shown :], goal)

    def move_target(self, state: State, position: jax.Array) -> State:
        """See `GoalEnv`; `position` is the true one."""
        moved = self.task.move_target(self._true(state), position)
        physics = state.pipeline_state.replace(true=moved.pipeline_state)
        return self._advance(state, physics, moved.info["plan"], state.info["step"])

    def aim(self, plan: Any, position: jax.Array) -> Any:
        """See `GoalEnv`."""
        return self.task.aim(plan, position)

    def lift_test_action(self, action: jax.Array) -> jax.Array:
        """See `GoalEnv`; what the probe does comes as late as what the policy does."""
        return self.task.lift_test_action(action)

    def outcome(self, end: State, lifted: State) -> EpisodeMetrics:
        """Measures an episode by its true positions."""
        return self.task.outcome(self._true(end), self._true(lifted))

    def _true(self, state: State) -> State:
        """Returns the task's own state, without errors."""
        plan, step = state.info["plan"], state.info["step"]
        return self.task._observe(state.pipeline_state.true, plan, step, state.metrics)

    def overflow(self, physics: RandomizedPhysics) -> jax.Array:
        """See `GoalEnv`."""
        return self.task.overflow(physics.true)

    def prepare(self) -> None:
        """See `GoalEnv`."""
        self.task.prepare()

    def reference_physics(self) -> "RandomizedEnv":
        """See `GoalEnv`."""
        return RandomizedEnv(self.task.reference_physics(), self.randomization)

    def with_sizes(self, sizes: Mapping[str, Any]) -> "RandomizedEnv":
        """Returns the task with other sizes, by the fields of `Randomization`, which may be traced.

        So one program measures many sizes. What the program is made for stays: no delay may be longer than
        `randomization` has it, what it leaves alone is left alone, and `posture` and `history` are its own.
        """
        env = copy.copy(self)
        env._sizes = self._sizes | dict(sizes)
        return env

    def curriculum(self, progress: jax.Array | float) -> "RandomizedEnv":
        """See `GoalEnv`: the disturbances grow from none to their sizes, and the task may become harder itself."""
        ramp, none = self.randomization.ramp, vars(self.randomization.nominal())
        share = jnp.minimum(progress / ramp, 1.0) if ramp else jnp.ones(())

        def grown(least: float, most: float) -> jax.Array:
            return (1.0 - share) * least + share * most

        env = self.with_sizes({name: jax.tree.map(grown, none[name], self._sizes[name]) for name in RAMPED})
        env.task = self.task.curriculum(progress)
        return env

    def nominal(self) -> "RandomizedEnv":
        """Returns the task without disturbances, whose observations are as long."""
        return RandomizedEnv(self.task, self.randomization.nominal())


def randomize(task: GoalEnv, randomization: Randomization | str) -> GoalEnv:
    """Returns a task under a randomisation, or a level of `LEVELS`; the task itself where that changes nothing.

    Raises:
      ValueError: there is no such level, or the task lacks what it asks for.

    """
    if isinstance(randomization, str):
        if randomization not in LEVELS:
            raise ValueError(f"unknown randomize {randomization!r}; choose from {', '.join(LEVELS)}")
        randomization = LEVELS[randomization]
    return task if randomization == Randomization() else RandomizedEnv(task, randomization)


def _between(limits: Range, share: jax.Array) -> jax.Array:
    least, most = limits
    return least + (most - least) * share

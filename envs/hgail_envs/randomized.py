"""Wraps a task so that each of its episodes is randomised: robot, object, sensors and start differ."""

import copy
import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from hgail_envs.base import Controller, EpisodeMetrics, GoalEnv, State
from hgail_envs.layout import past
from hgail_envs.randomization import LEVELS, MODEL_FACTORS, Randomization, Range
from hgail_envs.variation import SOURCES, Drawn, ModelFactors, RandomizedPhysics
from hgail_envs.wrapper import Wrapper


class RandomizedEnv(Wrapper):
    """A randomised task; the sizes of each episode are drawn with its key at the reset.

    Actions take effect late, their displacements are scaled, and the observed positions of gripper, object and goal
    have errors. The features are the past, then the task's own. The past is `known_delay` actions that have not taken
    effect, newest first, each after a 1, with zeros where the delay is shorter; then `history` of the last actions and
    observations. Hindsight relabels with observed goals: the position in an achieved goal has the same error as the one
    in the episode's desired goal, since the same camera measures both. Reward, success and distances are of the true
    positions.

    An action begins with a displacement in x, y and z, and a goal with a position, as far as they have three numbers. A
    task that lacks `add_sensor_noise`, `vary_model` or `vary_start`, which a size needs, is a ValueError.
    """

    def __init__(self, task: GoalEnv, randomization: Randomization) -> None:
        needed = {
            "add_sensor_noise": randomization.has_sensor_noise,
            "vary_model": randomization.varies_model,
            "vary_start": randomization.varies_start,
        }
        for method, is_needed in needed.items():
            if is_needed and getattr(type(task), method) is getattr(GoalEnv, method):
                lacking = f"{type(task).__name__} cannot be randomised so: it has no {method}"
                raise ValueError(f"{lacking}; write it, or take a randomisation that needs none")
        given = [name for name in task.not_randomized if getattr(randomization, name) != getattr(Randomization, name)]
        if given:
            raise ValueError(
                f"{type(task).__name__} cannot be randomised so: its object has no free joint, to which {given[0]}"
                f" would apply; take a randomisation without {', '.join(given)}"
            )
        super().__init__(task)
        self.randomization, self._sizes = randomization, dict(vars(randomization))
        known, remembered = randomization.known_delay, randomization.history
        self._past_size = known * (1 + task.action_size) + remembered * (task.action_size + task.feature_size)
        self.feature_size = self._past_size + task.feature_size
        self.features_layout = past(task.features_layout, task.action_layout, remembered, known) + task.features_layout
        self.controllers = {  # type: ignore[misc]
            name: functools.partial(_act_now, act, self._past_size) for name, act in task.controllers.items()
        }

    def reset_physics(self, rng: jax.Array) -> RandomizedPhysics:
        sizes, task = self.randomization, self.task
        task_rng, start_rng, drawn_rng, offset_rng, noise_rng = jax.random.split(rng, 5)
        uniforms = jax.random.uniform(drawn_rng, (3 + len(MODEL_FACTORS),))  # one draw compiles the fastest
        true = task.reset_physics(task_rng)
        if sizes.varies_model:
            pairs = zip(MODEL_FACTORS, uniforms[3:], strict=True)
            factors = {name: _between(self._sizes[name], uniform) for name, uniform in pairs}
            true = task.vary_model(true, ModelFactors(**factors))
        if sizes.varies_start:  # after the model, as far as whose hand opens
            true = task.vary_start(start_rng, true, sizes.posture, self._sizes["hand_opening"])
        physics = RandomizedPhysics(
            true=true,
            drawn=self._drawn(uniforms[:3], jax.random.normal(offset_rng, (3, 3))),
            rng=jax.random.key_data(noise_rng),  # raw integers: NumPy cannot convert a typed key
            noise=jnp.zeros((3, 3)),
            noise_before=jnp.zeros((3, 3)),
            pending=jnp.zeros((sizes.delay[1], task.action_size)),
            history=jnp.zeros((sizes.history, task.action_size + task.feature_size)),
        )
        physics = self._draw_noise(physics)
        physics = physics.replace(noise_before=physics.noise)  # nothing has moved, so no velocity has an error
        return self._with_first_history(physics)

    def _with_first_history(self, physics: RandomizedPhysics) -> RandomizedPhysics:
        """Returns a start whose history is the start itself, time and again."""
        first = jnp.concatenate([jnp.zeros(self.action_size), self._observed_features(physics)])
        return physics.replace(history=jnp.broadcast_to(first, physics.history.shape))

    def _drawn(self, uniforms: jax.Array, normals: jax.Array) -> Drawn:
        """Scales uniform numbers in [0, 1), `[3]`, to ranges, and standard normal ones, `[3, 3]`, to offsets."""
        least, most = self._sizes["delay"]
        # Both bounds are included, hence the + 1. In single precision the draw may round up to `most + 1`, and `most`
        # is no whole number during the ramp.
        delay = jnp.minimum(jnp.floor(_between((least, most + 1), uniforms[0])), jnp.ceil(most))
        deviations = jnp.array([self._sizes[f"{source}_offset"] for source in SOURCES])
        return Drawn(
            delay=delay.astype(jnp.int32),
            step_size=_between(self._sizes["step_size"], uniforms[1]),
            z_bias=_between(self._sizes["z_bias"], uniforms[2]),
            offset=deviations[:, None] * normals,
        )

    def _draw_noise(self, physics: RandomizedPhysics) -> RandomizedPhysics:
        """Returns the physics with the sensors' noise of the next step."""
        following_rng, rng = jax.random.split(jax.random.wrap_key_data(physics.rng))
        deviations = jnp.array([self._sizes[f"{source}_noise"] for source in SOURCES])
        return physics.replace(
            rng=jax.random.key_data(following_rng),
            noise=deviations[:, None] * jax.random.normal(rng, (3, 3)),
            noise_before=physics.noise,
        )

    def step_physics(self, physics: RandomizedPhysics, action: jax.Array) -> RandomizedPhysics:
        """Steps the task with a late and scaled action, whose displacements may exceed [-1, 1]; see `GoalEnv`."""
        drawn, queue = physics.drawn, jnp.concatenate([action[None], physics.pending])
        entry = jnp.concatenate([action, self._observed_features(physics)])
        late, axes = queue[drawn.delay], min(3, self.action_size)
        late = late.at[:axes].multiply(drawn.step_size)
        if axes == 3:
            late = late.at[2].add(-drawn.z_bias)  # a positive bias sinks the gripper
        moved = physics.replace(
            true=self.task.step_physics(physics.true, late),
            pending=queue[: len(physics.pending)],
            history=jnp.concatenate([entry[None], physics.history])[: len(physics.history)],
        )
        return self._draw_noise(moved)

    def _observed_features(self, physics: RandomizedPhysics) -> jax.Array:
        """Returns the task's features with sensor errors, `[feature_size]` of the task."""
        if not self.randomization.has_sensor_noise:
            return self.task.features(physics.true)
        return self.task.features(self.task.add_sensor_noise(physics.true, physics.errors()))

    def features(self, physics: RandomizedPhysics) -> jax.Array:
        """Returns the past, then the task's features with sensor errors; see `GoalEnv`."""
        before = self._on_their_way(physics).reshape(-1), physics.history.reshape(-1)
        return jnp.concatenate([*before, self._observed_features(physics)])

    def _on_their_way(self, physics: RandomizedPhysics) -> jax.Array:
        """Returns the actions that have not taken effect, newest first, each after a 1: `[known_delay, 1 + size]`."""
        count, pending = self.randomization.known_delay, physics.pending
        newest = jnp.zeros((count, self.action_size)).at[: len(pending)].set(pending[:count])
        marked = jnp.concatenate([jnp.ones((count, 1)), newest], axis=1)
        return jnp.where(jnp.arange(count)[:, None] < physics.drawn.delay, marked, 0.0)

    def goal_observation(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns the past, then the task's own observation; see `GoalEnv`."""
        before, own = features[..., : self._past_size], features[..., self._past_size :]
        return jnp.concatenate([before, self.task.goal_observation(own, goal)], axis=-1)

    @property
    def observation_size(self) -> int:
        return self._past_size + self.task.observation_size

    def achieved_goal(self, physics: RandomizedPhysics) -> jax.Array:
        """Returns the achieved goal with the sensors' error; see `GoalEnv`."""
        return self._with_error(self.task.achieved_goal(physics.true), physics.goal_error)

    def sample_goal(self, rng: jax.Array, physics: RandomizedPhysics) -> jax.Array:
        """Draws the true goal, `[goal_size]`, without the sensors' error."""
        return self.task.sample_goal(rng, physics.true)

    def training_start(
        self, rng: jax.Array, physics: RandomizedPhysics, training_goals: jax.Array | bool
    ) -> RandomizedPhysics:
        true = self.task.training_start(rng, physics.true, training_goals)
        return self._with_first_history(physics.replace(true=true))

    def plan_goals(self, rng: jax.Array, physics: RandomizedPhysics, training_goals: jax.Array | bool) -> Any:
        return self.task.plan_goals(rng, physics.true, training_goals)

    def current_goal(self, plan: Any, physics: RandomizedPhysics, step: jax.Array | int) -> jax.Array:
        """Returns the desired goal with the sensors' error, `[goal_size]`."""
        return self._with_error(self.task.current_goal(plan, physics.true, step), physics.goal_error)

    def _with_error(self, goal: jax.Array, error: jax.Array) -> jax.Array:
        """Returns a goal, `[goal_size]`, with an error in its position."""
        axes = min(3, self.goal_size)
        return goal.at[:axes].add(error[:axes])

    def success(self, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        return self.task.success(achieved, desired)

    def reached(self, physics: RandomizedPhysics, desired: jax.Array) -> jax.Array:
        """Returns whether the true state is at the true goal that is observed as `desired`: a boolean `[]`."""
        return self.task.reached(physics.true, self._with_error(desired, -physics.goal_error))

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        return self.task.goal_kind(goal)

    def goal_test(self, features: jax.Array, achieved: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns whether observed positions are at observed goals, for a buffer has no true ones; see `GoalEnv`."""
        return self.task.goal_test(features[..., self._past_size :], achieved, goal)

    def goal_tolerance(self, goal: jax.Array) -> jax.Array:
        return self.task.goal_tolerance(goal)

    def already_solved(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        return self.task.already_solved(features[..., self._past_size :], goal)

    def move_target(self, state: State, position: jax.Array) -> State:
        """Moves the target to the true `position`; see `GoalEnv`."""
        moved = self.task.move_target(self._true_state(state), position)
        physics = state.pipeline_state.replace(true=moved.pipeline_state)
        return self._advance(state, physics, moved.info["plan"], state.info["step"])

    def lift_test_action(self, action: jax.Array) -> jax.Array:
        return self.task.lift_test_action(action)

    def outcome(self, end: State, lifted: State) -> EpisodeMetrics:
        """Measures an episode by its true positions; see `GoalEnv`."""
        return self.task.outcome(self._true_state(end), self._true_state(lifted))

    def _true_state(self, state: State) -> State:
        plan, step = state.info["plan"], state.info["step"]
        return self.task._make_state(state.pipeline_state.true, plan, step, state.metrics)

    def overflow(self, physics: RandomizedPhysics) -> jax.Array:
        return self.task.overflow(physics.true)

    def prepare(self) -> None:
        self.task.prepare()

    def reference_physics(self) -> "RandomizedEnv":
        return RandomizedEnv(self.task.reference_physics(), self.randomization)

    def with_sizes(self, sizes: Mapping[str, Any]) -> "RandomizedEnv":
        """Returns the task with other sizes, by the fields of `Randomization`, which may be traced.

        Its structure stays that of `randomization`: no delay may be longer than there, `posture`, `history` and
        `known_delay` stay, and a model, start or sensors that are nominal there stay nominal.
        """
        env = copy.copy(self)
        env._sizes = self._sizes | dict(sizes)
        return env

    def curriculum(self, progress: jax.Array | float) -> "RandomizedEnv":
        """Returns the task with its sizes ramped from nominal, over the task's own curriculum; see `GoalEnv`."""
        ramp, nominal = self.randomization.ramp, vars(self.randomization.nominal())
        done = jnp.minimum(progress / ramp, 1.0) if ramp else jnp.ones(())

        def ramped(start: float, end: float) -> jax.Array:
            return (1.0 - done) * start + done * end  # exactly the end at 1, as start + done * (end - start) is not

        names = self.randomization.ramped
        env = self.with_sizes({name: jax.tree.map(ramped, nominal[name], self._sizes[name]) for name in names})
        env.task = self.task.curriculum(progress)
        return env

    def nominal(self) -> "RandomizedEnv":
        """Returns the nominal task, with observations of the same size."""
        return RandomizedEnv(self.task, self.randomization.nominal())


def randomize(task: GoalEnv, randomization: Randomization | str) -> GoalEnv:
    """Returns a task under a randomisation, or one of `LEVELS` (else a ValueError); the task itself if nominal."""
    if isinstance(randomization, str):
        if randomization not in LEVELS:
            raise ValueError(f"unknown randomize {randomization!r}; choose from {', '.join(LEVELS)}")
        randomization = LEVELS[randomization]
    return task if randomization == Randomization() else RandomizedEnv(task, randomization)


def _act_now(controller: Controller, past_size: int, observation: jax.Array) -> jax.Array:
    """Returns a controller's action on an observation without its past."""
    return controller(observation[..., past_size:])


def _between(bounds: Range, uniform: jax.Array) -> jax.Array:
    least, most = bounds
    return least + (most - least) * uniform

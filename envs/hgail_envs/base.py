"""The interface between a goal-reaching task and the learner."""

import abc
import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State
from flax import struct

from hgail_envs.layout import FLAG, HasLayouts
from hgail_envs.variation import ModelFactors, SensorErrors

Controller = Callable[[jax.Array], jax.Array]
"""A scripted policy without a memory: observations `[..., observation_size]` to actions `[..., action_size]` in
[-1, 1]."""


class EpisodeMetrics(struct.PyTreeNode):
    """Outcome of an episode: numbers `[]`, one per episode under `jax.vmap`, or means over episodes."""

    success: jax.Array | float = 0.0
    """1 if the episode is a success by the task's strictest test, after the last step and the lift test, else 0."""
    achieved: jax.Array | float = 0.0
    """1 if the last step satisfies the goal, else 0; differs from `success` in a task with a lift test."""
    success_l1: jax.Array | float = 0.0
    """1 if the L1 distance is within the task's threshold, as in the paper, else 0."""
    distance_l1: jax.Array | float = 0.0
    """L1 distance between the last step's position and the target, in the goal's unit."""
    distance_l2: jax.Array | float = 0.0
    """Euclidean distance between them."""


@dataclasses.dataclass(frozen=True)
class TrainingDefaults:
    """Changes to the settings that a learner has on a platform, for a task; the user's own go before them."""

    config: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Changes to the fields of `hgail_jax.Config`, or of its learner."""
    hyperparameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Changes to the fields of `hgail_jax.Hyperparameters`."""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the task's own class, e.g. `substeps` of the Fetch tasks."""
    evaluate_every: int = 1
    """Rounds from one evaluation to the next."""
    method: str = "hgail"
    """Name of the default method, in `hgail_jax.METHODS`."""


class GoalEnv(HasLayouts, Env):
    """A task in which a state must be brought to a goal within `episode_length` steps.

    It has brax's `reset` and `step`, so that brax's ES and ARS can train on it (PPO, SAC and APG of brax 0.14.2 need an
    older JAX), and a goal interface from which hindsight can rebuild an observation for another goal without stepping.
    All is for a single environment; batches come from `jax.vmap`. `P` below is the task's physics state, any pytree.

    A task sets the five class attributes without a value and implements the five abstract methods; the others have
    defaults. In place of sizes it may declare layouts (`features_layout` and so on), which also name the numbers.
    Episodes never end early: `done` stays 0, and the caller truncates an episode at the time limit.

    The goals of an episode follow a plan, drawn by `plan_goals` at the reset; from it `current_goal` returns the goal
    of a step. A task that learns better on other goals than those of its evaluation has training goals, the plans of
    episodes reset with `training_goals`: a random place, a stage on the way, a new place every few steps.

    `State.info` holds `features` (`[feature_size]`), `achieved_goal` and `desired_goal` (`[goal_size]`), the `plan`
    (any pytree) and the `step` (`[]` integer, from 0). `State.obs` is the observation, `goal_observation(features,
    desired_goal)`, `[observation_size]`. `State.reward` is -1, or 0 if the state is at the goal (`goal_test`).
    """

    episode_length: int
    """Steps in an episode."""
    success_threshold: float
    """Largest Euclidean distance between achieved and desired goal that counts as success."""
    goal_kinds: int = 1
    """Kinds of goals, see `goal_kind`."""
    lift_test_steps: int = 0
    """Steps that an evaluation appends to an episode to test a grasp, see `lift_test_action`."""
    observation_limit: float = 1e3
    """Largest absolute observation of a valid simulation; beyond it, or not a number, the episode is left out."""
    max_worlds: int | None = None
    """Environments that its physics can step at once; None is any number."""
    control_period: float = 0.04
    """Seconds between two actions, at which an episode is played."""
    scene: str | Path | None = None
    """MJCF scene: the name of one of the package, e.g. `"reach"`, or a path that ends with `.xml`, relative to the
    class's own file; None for a task that cannot be rendered. The physics of a task with a scene have `qpos`, and its
    goals begin with the target's position, metres, world frame."""
    robot: Any = None
    """The `hgail_envs.robots.base.Robot` in its scene; None for a task without a scene."""
    instruction: str = ""
    """The task as one sentence, for policies that read instructions in language."""
    target_body: str | None = None
    """Name of the scene's body that is the target itself; None if the target is drawn as a marker."""
    shows_goal: bool = False
    """Whether the scene without the marker shows the goal of an evaluation, as a cube that another one is put on."""
    reference: str | None = None
    """Name of the Gymnasium environment that the task is compared with."""
    not_randomized: tuple[str, ...] = ()
    """Fields of `Randomization` that cannot apply to it, and are refused."""
    controllers: ClassVar[Mapping[str, Controller]] = {}
    """Scripted controllers by name; the first demonstrates the task."""
    training: ClassVar[Mapping[str, Mapping[str, TrainingDefaults]]] = {}
    """Settings of its training, by learner (`"ppo"`, `"td3"`) and platform (`"cpu"`, `"gpu"`); the learner that stands
    first is the task's default."""

    @abc.abstractmethod
    def reset_physics(self, rng: jax.Array) -> Any:
        """Returns the physics state `P` at the start of an episode."""

    @abc.abstractmethod
    def step_physics(self, physics: Any, action: jax.Array) -> Any:
        """Returns the physics state `P` after `action`, `[action_size]`, already clipped to [-1, 1]."""

    @abc.abstractmethod
    def features(self, physics: Any) -> jax.Array:
        """Returns the policy's observation without the goal, `[feature_size]`."""

    @abc.abstractmethod
    def achieved_goal(self, physics: Any) -> jax.Array:
        """Returns the goal that the physics state achieves, `[goal_size]`."""

    @abc.abstractmethod
    def sample_goal(self, rng: jax.Array, physics: Any) -> jax.Array:
        """Draws the desired goal of an evaluation episode that starts in `physics`, `[goal_size]`."""

    def training_start(self, rng: jax.Array, physics: Any, training_goals: jax.Array | bool) -> Any:
        """Returns the physics at the start of an episode; by default `physics`, which `reset_physics` returned.

        An episode with `training_goals`, a flag that may be traced, may start at a later stage; any other starts there.
        """
        return physics

    def plan_goals(self, rng: jax.Array, physics: Any, training_goals: jax.Array | bool) -> Any:
        """Draws the plan of an episode's goals, which starts in `physics`; by default one goal of `sample_goal`.

        All randomness of the goals is drawn here. `training_goals`, which may be traced, selects the task's training
        goals; the plan is any pytree, of the same structure and shapes in either case.
        """
        return self.sample_goal(rng, physics)

    def current_goal(self, plan: Any, physics: Any, step: jax.Array | int) -> jax.Array:
        """Returns the desired goal, `[goal_size]`, in `physics` after `step` steps; by default the plan itself."""
        return plan

    def goal_observation(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns the observation of `features`, `[..., feature_size]`, under `goal`, `[..., goal_size]`."""
        return jnp.concatenate([features, goal], axis=-1)

    def success(self, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        """Returns whether goals satisfy others, `[..., goal_size]`: `[...]`, for trainers that keep no features.

        By default flags of `goal_layout` are equal and the other numbers within `success_threshold`.
        """
        return self.goal_layout.is_near(achieved, desired, self.success_threshold)

    def goal_kind(self, goal: jax.Array) -> jax.Array:
        """Returns the kind of goals, `[..., goal_size]`: integers `[...]` below `goal_kinds`.

        Hindsight draws its goals so that each kind is as frequent among them as among the desired ones, if a roll-out
        achieved it at all. Else a rare kind is hardly taught, and the discriminator separates samples by their kind.
        """
        return jnp.zeros(goal.shape[:-1], jnp.int32)

    def goal_test(self, features: jax.Array, achieved: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns whether states are at goals, `[..., goal_size]`: booleans `[...]`, the test of reward and success.

        A replay buffer keeps of a state its `features`, `[..., feature_size]`, and its `achieved` goal, `[...,
        goal_size]`. By default the test is `success` of the achieved goal.
        """
        return self.success(achieved, goal)

    def goal_tolerance(self, goal: jax.Array) -> jax.Array:
        """Returns half the edges of a box around goals, both `[..., goal_size]`, that is within what counts as reached.

        A state that achieves a goal is at every goal of the box around it, by `goal_test`. A discriminator may take its
        positives' goals from there, see `Hyperparameters.goal_jitter`. By default a cube, with flags as they are.
        """
        numbers = np.array([number.unit != FLAG for number in self.goal_layout.numbers], np.float32)
        half = self.success_threshold / np.sqrt(np.maximum(numbers.sum(), 1.0))
        return jnp.broadcast_to(half.astype(np.float32) * numbers, goal.shape)

    def reached(self, physics: Any, desired: jax.Array) -> jax.Array:
        """Returns whether `physics` is at the goal `desired`, `[goal_size]`, by `goal_test`: a boolean `[]`."""
        return self.goal_test(self.features(physics), self.achieved_goal(physics), desired)

    def already_solved(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns whether relabelled goals, `[..., goal_size]`, are already solved by the states that act: `[...]`.

        Those states have `features`, `[..., feature_size]`. Hindsight may weigh such goals less, see
        `Hyperparameters.solved_weight`; by default none is solved.
        """
        return jnp.zeros(goal.shape[:-1], bool)

    def move_target(self, state: State, position: jax.Array) -> State:
        """Returns a state with the target, and its body if it has one, at `position`, `[3]`, metres, e.g. dragged."""
        plan = self.aim(state.info["plan"], position)
        return self._advance(state, state.pipeline_state, plan, state.info["step"])

    def aim(self, plan: Any, position: jax.Array) -> Any:
        """Returns a plan with the target at `position`, `[3]`; by default the plan is a goal that begins with it."""
        return plan.at[:3].set(position)

    def lift_test_action(self, action: jax.Array) -> jax.Array:
        """Returns the action of a step of the lift test, given the one before, both `[action_size]`."""
        return action

    def outcome(self, end: State, lifted: State) -> EpisodeMetrics:
        """Measures an episode by its last state, `end`, and by the state at the end of the lift test, `lifted`.

        Without a lift test, as in all roll-outs for training, `lifted` is `end`.
        """
        achieved, desired = end.info["achieved_goal"], end.info["desired_goal"]
        return self.measure(achieved, desired, self.goal_test(end.info["features"], achieved, desired))

    def measure(
        self,
        position: jax.Array,
        target: jax.Array,
        achieved: jax.Array | bool = False,
        success: jax.Array | bool | None = None,
    ) -> EpisodeMetrics:
        """Returns the metrics of an episode from the fields `achieved` and `success`, which is `achieved` if None.

        The last step's `position` and its `target` are `[3]`, or goals, `[goal_size]`, whose metres count if any.
        """
        position, target = (self.goal_layout.metres(jnp.asarray(each)) for each in (position, target))
        l1 = jnp.sum(jnp.abs(position - target))  # the paper's success is by this distance
        return EpisodeMetrics(
            success=jnp.asarray(achieved if success is None else success, jnp.float32),
            achieved=jnp.asarray(achieved, jnp.float32),
            success_l1=(l1 <= self.success_threshold).astype(jnp.float32),
            distance_l1=l1,
            distance_l2=jnp.linalg.norm(position - target),
        )

    def overflow(self, physics: Any) -> jax.Array:
        """Returns whether the simulation exceeded its contact buffers and is invalid: a boolean `[]`."""
        return jnp.zeros((), bool)

    def add_sensor_noise(self, physics: Any, errors: SensorErrors) -> Any:
        """Returns `physics` with sensor errors added, for `features`; a randomisation with sensor noise needs it."""
        raise NotImplementedError

    def vary_model(self, physics: Any, factors: ModelFactors) -> Any:
        """Returns a start with a scaled model; a randomisation of friction, masses or sizes needs it."""
        raise NotImplementedError

    def vary_start(self, rng: jax.Array, physics: Any, shift: float, opening: jax.Array | float) -> Any:
        """Returns a start with another posture of the robot; a randomisation of `posture` or `hand_opening` needs it.

        The gripper is displaced by at most `shift` along each axis, metres; `opening` is the largest opening of the
        hand, as a fraction of its widest in the varied model.
        """
        raise NotImplementedError

    def prepare(self) -> None:
        """Warms up the physics while the caller compiles, e.g. builds kernels; by default nothing."""
        return

    def curriculum(self, progress: jax.Array | float) -> "GoalEnv":
        """Returns the task that training uses at this progress, e.g. an easier one at first; by default this one.

        Its sizes, observations and goals must mean the same as this one's. `progress`, `[]`, is the fraction of the
        rounds that is done and may be traced; at 1 the task is this one.
        """
        return self

    def reference_physics(self) -> "GoalEnv":
        """Returns the task with its reference physics, the most accurate; by default the task itself."""
        return self

    def reset(self, rng: jax.Array, training_goals: jax.Array | bool = False) -> State:
        """Starts an episode with an evaluation goal, or with training goals; the flag may be traced."""
        physics_rng, goal_rng = jax.random.split(rng)  # fold_in makes the same of 0 and 1, and a third key of 2
        physics = self.training_start(jax.random.fold_in(rng, 2), self.reset_physics(physics_rng), training_goals)
        plan = self.plan_goals(goal_rng, physics, training_goals)
        return self._make_state(physics, plan, jnp.zeros((), jnp.int32), {})

    def step(self, state: State, action: jax.Array) -> State:
        """Takes one step; `action`, `[action_size]`, is clipped to [-1, 1]. Another shape is a ValueError."""
        if jnp.shape(action) != (self.action_size,):
            raise ValueError(f"an action has the shape {jnp.shape(action)}; it must be {(self.action_size,)}")
        physics = self.step_physics(state.pipeline_state, jnp.clip(action, -1.0, 1.0))
        return self._advance(state, physics, state.info["plan"], state.info["step"] + 1)

    def _advance(self, state: State, physics: Any, plan: Any, step: jax.Array) -> State:
        """Returns `state` with other physics, another plan and another step."""
        following = self._make_state(physics, plan, step, state.metrics)
        # brax's wrappers keep entries of their own in info, and a scan needs the same structure at every step.
        return following.replace(info=state.info | following.info)

    def _make_state(self, physics: Any, plan: Any, step: jax.Array, metrics: dict[str, jax.Array]) -> State:
        features, desired = self.features(physics), self.current_goal(plan, physics, step)
        return State(
            pipeline_state=physics,
            obs=self.goal_observation(features, desired),
            reward=self.reached(physics, desired).astype(jnp.float32) - 1.0,
            done=jnp.zeros(()),  # or brax would reset the episode, and hindsight relabel across two episodes
            metrics=metrics,
            info={
                "features": features,
                "achieved_goal": self.achieved_goal(physics),
                "desired_goal": desired,
                "plan": plan,
                "step": step,
            },
        )

    @property
    def observation_size(self) -> int:
        """Numbers in `State.obs`; a task with a `goal_observation` of its own overrides this too."""
        return self.feature_size + self.goal_size

    @property
    def goal_observation_size(self) -> int:
        """Numbers in a `goal_observation`: in `State.obs` a wrapper may add others, which no goal changes."""
        return self.observation_size

    @property
    def backend(self) -> str:
        """Brax's name for the physics, by default `"mjx"`."""
        return "mjx"

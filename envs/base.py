"""The interface between a goal-reaching task and the learner."""

import abc

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State


class GoalEnv(Env):
    """A task in which a state must be brought to a goal within `episode_length` steps.

    It has brax's `reset` and `step`, so any brax trainer can drive it, and a goal interface from which hindsight can
    rebuild an observation for another goal without stepping. Everything here is for a single environment; batches
    come from `jax.vmap`. `P` below is the task's own physics state, any pytree.

    A task sets the five class attributes and implements the five abstract methods. Episodes never end early:
    `done` stays 0 and the time limit is the caller's, who treats it as a truncation.

    `State.info` holds `observation` (`[feature_size]`), `achieved_goal` and `desired_goal` (`[goal_size]`).
    `State.obs` is `goal_observation(observation, desired_goal)`, `[observation_size]`. `State.reward` is -1, or 0
    where the achieved goal is a success.
    """

    episode_length: int
    """Steps in an episode."""
    feature_size: int
    """Numbers in the part of the observation that does not depend on the goal."""
    goal_size: int
    """Numbers in a goal."""
    action_size: int
    """Numbers in an action; each is clipped to [-1, 1]."""
    success_threshold: float
    """Largest Euclidean distance between achieved and desired goal that counts as success."""

    @abc.abstractmethod
    def reset_physics(self, rng: jax.Array):
        """Returns the physics state `P` at the start of an episode."""

    @abc.abstractmethod
    def step_physics(self, physics, action: jax.Array):
        """Returns the physics state `P` after `action`, `[action_size]`, already clipped to [-1, 1]."""

    @abc.abstractmethod
    def features(self, physics) -> jax.Array:
        """Returns what the policy sees besides the goal, `[feature_size]`."""

    @abc.abstractmethod
    def achieved_goal(self, physics) -> jax.Array:
        """Returns the goal that the physics state achieves, `[goal_size]`."""

    @abc.abstractmethod
    def sample_goal(self, rng: jax.Array, physics) -> jax.Array:
        """Draws the desired goal of an episode that starts in `physics`, `[goal_size]`."""

    def goal_observation(self, features: jax.Array, goal: jax.Array) -> jax.Array:
        """Returns the observation of `features`, `[..., feature_size]`, under `goal`, `[..., goal_size]`."""
        return jnp.concatenate([features, goal], axis=-1)

    def success(self, achieved: jax.Array, desired: jax.Array) -> jax.Array:
        """Returns whether goals `achieved` satisfy goals `desired`: booleans `[...]` from two `[..., goal_size]`."""
        return jnp.linalg.norm(achieved - desired, axis=-1) <= self.success_threshold

    def accurate(self, when: jax.Array | bool = True) -> "GoalEnv":
        """Returns the task with its most accurate physics where `when`, which may be traced, and as it is elsewhere.

        A task with one physics only returns itself.
        """
        return self

    def reset(self, rng: jax.Array) -> State:
        """Starts an episode; see the class for what the state holds."""
        physics_rng, goal_rng = jax.random.split(rng)
        physics = self.reset_physics(physics_rng)
        return self._observe(physics, self.sample_goal(goal_rng, physics), metrics={})

    def step(self, state: State, action: jax.Array) -> State:
        """Takes one step; `action`, `[action_size]`, is clipped to [-1, 1]."""
        physics = self.step_physics(state.pipeline_state, jnp.clip(action, -1.0, 1.0))
        following = self._observe(physics, state.info["desired_goal"], state.metrics)
        return following.replace(info=state.info | following.info)

    def _observe(self, physics, desired: jax.Array, metrics: dict) -> State:
        features, achieved = self.features(physics), self.achieved_goal(physics)
        return State(
            pipeline_state=physics,
            obs=self.goal_observation(features, desired),
            reward=self.success(achieved, desired).astype(jnp.float32) - 1.0,
            done=jnp.zeros(()),
            metrics=metrics,
            info={"observation": features, "achieved_goal": achieved, "desired_goal": desired},
        )

    @property
    def observation_size(self) -> int:
        """Numbers in `State.obs`; a task with a `goal_observation` of its own overrides this too."""
        return self.feature_size + self.goal_size

    @property
    def backend(self) -> str:
        """Brax's name for the physics; `"mjx"` unless the task says otherwise."""
        return "mjx"

"""A policy at work, action by action, on a target that can be moved at any time."""

import dataclasses
import enum
import functools
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from hgail_envs import GoalEnv, State
from hgail_envs.scenes import open_scene, pose
from hgail_envs.vision.camera_env import CameraEnv
from hgail_jax.io.policy import AnyPolicy
from hgail_jax.rollout import lift_test_step
from hgail_jax.vision.policy import acting

Actor = AnyPolicy | Callable[[np.ndarray], np.ndarray]
"""A trained policy, or a function of an observation, `[observation_size]`, to an action, `[action_size]`."""

_REST = 1.0  # seconds that the scene stands still after an episode
_SAMPLED_GOALS = 1024  # from which the bounds of the target are taken


class Phase(enum.Enum):
    """Phase of a session."""

    ACTING = "acting"
    """The policy acts, with its episode's time running."""
    LIFT_TEST = "lift test"
    """The policy's time is over, and the task tests its grasp."""
    STAYING = "staying"
    """The episode was a success, and the policy continues at the same target, because it was moved there by hand."""
    RESTING = "resting"
    """The episode is over; the scene stands still."""


@dataclasses.dataclass(frozen=True)
class Status:
    """Status of a session."""

    phase: Phase
    distance: float
    """Distance between the achieved goal, or the hand, and the target, metres."""
    reached: bool
    """Whether the last step satisfies the goal."""
    success: bool
    """Whether the episode is a success by the task's strictest test, as of now; final at its end."""
    episodes: int
    """Episodes that came to an end."""
    successes: int
    """Those of them that were a success."""


class Session:
    """A policy at work on a task that has a scene, action by action.

    Until the target is moved, episodes follow one another as the task starts them. Once it is moved, the target stays
    where it was put, and the time of the episode starts anew: after a success the policy continues there, and after
    a failure, or in a task that ends with a lift test, the next episode starts with the target in that place.

    For use in one thread. The seed is that of the starts.
    """

    def __init__(self, env: GoalEnv, policy: Actor, seed: int = 0) -> None:
        self.model, self.data = open_scene(env)
        self.env, self._policy = env, acting(env, policy)
        self._reset, self._step = jax.jit(env.reset), jax.jit(env.step)
        self._move, self._outcome = jax.jit(env.move_target), jax.jit(env.outcome)
        self._see = jax.jit(env.see) if isinstance(env, CameraEnv) else None
        self.phase = Phase.ACTING
        self.restart(seed)

    def restart(self, seed: int | None = None) -> None:
        """Lets go of the target and starts the next episode, or the first of another seed."""
        if seed is not None:
            self._starts = self._keys(seed)
            self.outcomes: list[bool] = []
            """Whether each episode that came to an end was a success."""
        self._held: np.ndarray | None = None
        self._begin()

    def move_target(self, position: np.ndarray) -> None:
        """Moves the target to a position, `[3]`, metres, world frame, or as near to it as the bounds allow."""
        self._held = np.clip(position, *self.bounds)
        if self.env.lift_test_steps and self.phase in (Phase.LIFT_TEST, Phase.RESTING):
            self._begin()  # a lift test leaves the arm where no episode takes it
        else:
            self._place_target()
            self._enter(Phase.ACTING)

    def step(self) -> None:
        """Takes one action, `env.control_period` seconds; starts the next episode if one is over."""
        self._before = self._state
        match self.phase:
            case Phase.RESTING:
                self._clock += 1
                if self._clock * self.env.control_period >= _REST:
                    self._begin()
            case Phase.ACTING | Phase.STAYING:
                action = self._policy(np.asarray(self._state.obs))
                self._advance(self._step(self._state, action), action)
                self._end = self._state
                if self.phase is Phase.ACTING and self._clock == self.env.episode_length:
                    self._enter(Phase.LIFT_TEST)
            case Phase.LIFT_TEST:
                self._advance(*lift_test_step(self.env, self._step, self._state, jnp.asarray(self._action)))
        if self.phase is Phase.LIFT_TEST and self._clock == self.env.lift_test_steps:
            self._conclude()

    @property
    def status(self) -> Status:
        """Status after the last action."""
        outcome = self._outcome(self._end, self._state)
        return Status(
            phase=self.phase,
            distance=float(outcome.distance_l2),
            reached=bool(self._end.reward >= 0.0),
            success=bool(outcome.success),
            episodes=len(self.outcomes),
            successes=sum(self.outcomes),
        )

    @property
    def time(self) -> float:
        """Time since the phase began, in the world of the simulation, seconds."""
        return self._clock * self.env.control_period

    @property
    def target(self) -> np.ndarray:
        """Position of the target, `[3]`, metres, world frame."""
        return np.asarray(self._state.info["desired_goal"])[:3]

    @property
    def seen(self) -> np.ndarray | None:
        """Pictures from the policy's cameras, `[cameras, size, size, 3]`, uint8, grey for depth; None without any."""
        if self._see is None:
            return None
        pictures = np.asarray(self._see(self._state.obs))
        return np.broadcast_to(pictures, (*pictures.shape[:-1], 3))

    def pose(self, fraction: float = 1.0) -> None:
        """Poses `data` between the states before (0) and after (1) the last action, with the target's site in place."""
        before, after = (np.asarray(state.pipeline_state.qpos, float) for state in (self._before, self._state))
        difference = np.zeros(self.model.nv)
        mujoco.mj_differentiatePos(self.model, difference, 1.0, before, after)
        mujoco.mj_integratePos(self.model, before, difference, fraction)
        pose(self.model, self.data, before, self.target)

    @functools.cached_property
    def bounds(self) -> np.ndarray:
        """Box of the task's goals, lowest and highest position, `[2, 3]`, metres, world frame."""
        keys = jax.random.split(jax.random.key(0), _SAMPLED_GOALS)
        goals = np.asarray(jax.jit(jax.vmap(self.env.reset))(keys).info["desired_goal"])[:, :3]
        return np.stack([goals.min(axis=0), goals.max(axis=0)])

    def _keys(self, seed: int) -> Iterator[jax.Array]:
        key = jax.random.key(seed)
        while True:
            key, episode = jax.random.split(key)
            yield episode

    def _begin(self) -> None:
        self._state = self._reset(next(self._starts))
        self._enter(Phase.ACTING)
        self._place_target()

    def _enter(self, phase: Phase) -> None:
        self.phase, self._clock = phase, 0

    def _place_target(self) -> None:
        if self._held is not None:
            self._state = self._move(self._state, self._held)
        self._before = self._end = self._state

    def _advance(self, state: State, action: jax.Array | np.ndarray) -> None:
        self._state, self._action = state, action
        self._clock += 1
        if not np.abs(np.asarray(self._state.obs)).max() <= self.env.observation_limit:  # the simulation broke down
            self._begin()

    def _conclude(self) -> None:
        self.outcomes.append(self.status.success)
        stays = self.outcomes[-1] and self._held is not None and not self.env.lift_test_steps
        self._enter(Phase.STAYING if stays else Phase.RESTING)

"""The interface of a learner: its state, its policy, and how a roll-out changes it."""

import abc
import enum
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import jax
import numpy as np

from hgail_envs import GoalEnv
from hgail_jax.config import Config
from hgail_jax.rollout import Policy, Trajectory
from hgail_jax.state import TrainState


class Phase(enum.IntEnum):
    """Use of a roll-out."""

    SKIP = 0
    """None; there is no roll-out either."""
    PRETRAIN = 1
    """Policy and discriminator are fitted to it (Algorithm 2, lines 1 to 3)."""
    POLICY = 2
    """The policy learns from it, under the discriminator's reward (a g_step)."""
    DISCRIMINATOR = 3
    """The discriminator learns to tell it from expert samples (a d_step)."""
    EVALUATE = 4
    """The mean action is measured, and nothing is learnt."""


SKIP, PRETRAIN, POLICY, DISCRIMINATOR, EVALUATE = Phase
LEARNING = (PRETRAIN, POLICY, DISCRIMINATOR)
"""The phases that learn."""

Update = Callable[[GoalEnv, Config, TrainState, Trajectory, jax.Array], tuple[TrainState, dict[str, jax.Array]]]
"""Task, sizes, state, a roll-out and a PRNG key to the new state and the update's metrics, `[]` by name."""


class Learner(abc.ABC):
    """Changes networks by roll-outs. It keeps nothing itself: its part of the training state is `TrainState.learner`.

    A learner is added by a subclass with its line in `hgail_jax.learners`, a dataclass of its sizes with its line in
    `hgail_jax.config.LEARNERS`, and settings in `hgail_jax.defaults`.
    """

    metrics: ClassVar[Mapping[str, str]]
    """Names of its updates' metrics, with their meanings."""
    updates: ClassVar[Mapping[Phase, Update]]
    """The update of each phase that learns."""
    squashes: ClassVar[bool] = False
    """Whether tanh brings its actions into [-1, 1]; else they are clipped."""

    @abc.abstractmethod
    def init(self, env: GoalEnv, config: Config, rngs: jax.Array) -> Any:
        """Returns the untrained networks and optimisers, from two PRNG keys, `[2]`."""

    @abc.abstractmethod
    def policy(
        self, env: GoalEnv, config: Config, state: TrainState, noise: jax.Array | float, axis: str | None = None
    ) -> Policy:
        """Returns the policy of `state`, to be rolled out.

        Args:
          env: the task.
          config: sizes and counts.
          state: the training state.
          noise: 1 to explore, 0 for the mean action; may be traced.
          axis: see `rollout`; in a device's part of the environments the policy acts as it would in all of them.

        """

    @abc.abstractmethod
    def progress(self, config: Config, state: TrainState) -> jax.Array:
        """Returns the fraction of the rounds that is done, `[]`."""

    @abc.abstractmethod
    def phase_table(self, config: Config) -> np.ndarray:
        """Returns the phases of a whole run, integers `[rounds + 1, phases]`, each row ending with an evaluation."""

    @abc.abstractmethod
    def layers(self, state: TrainState) -> list[tuple[jax.Array, ...]]:
        """Returns the layers of the mean action's network, as `MeanPolicy.layers` has them."""

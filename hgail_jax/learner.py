"""The interface of a learner: its sizes, its state, its policy, and how a roll-out changes it."""

import abc
import dataclasses
import enum
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import numpy as np

from hgail_envs import GoalEnv
from hgail_envs.validation import check_count

if TYPE_CHECKING:
    from hgail_jax.config import Config, Hyperparameters
    from hgail_jax.rollout import Detour, Policy, Trajectory
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
    """The discriminator learns to separate it from expert samples (a d_step)."""
    EVALUATE = 4
    """The mean action is measured, and nothing is learnt."""


SKIP, PRETRAIN, POLICY, DISCRIMINATOR, EVALUATE = Phase
LEARNING = (PRETRAIN, POLICY, DISCRIMINATOR)
"""The phases that learn."""

Update = Callable[[GoalEnv, "Config", "TrainState", "Trajectory", jax.Array], tuple["TrainState", dict[str, jax.Array]]]
"""Task, sizes, state, a roll-out and a PRNG key to the new state and the update's metrics, `[]` by name."""


@dataclasses.dataclass(frozen=True)
class Learner(abc.ABC):
    """Changes networks by roll-outs. A learner is a frozen dataclass of its sizes, and is what `Config.learner` is.

    It keeps nothing itself: its part of the training state is `TrainState.learner`. Another learner is a subclass in a
    file, its line in `hgail_jax.learners.LEARNERS`, and settings in `hgail_jax.settings`.
    """

    name: ClassVar[str]
    metrics: ClassVar[Mapping[str, str]]
    """Names of its updates' metrics, with their meanings."""
    hyperparameters: ClassVar[type["Hyperparameters"]]
    """Class of its hyperparameters: `Hyperparameters`, or a subclass with those that it alone reads."""
    without_effect: ClassVar[tuple[str, ...]] = ()
    """Options of `hgail train` that change nothing with this learner, and are refused."""
    ignored: ClassVar[tuple[str, ...]] = ()
    """Fields of `Config` and `Hyperparameters` that change nothing with this learner, and are refused."""
    convolves: ClassVar[bool] = False
    """Whether its networks have convolutions, for which a GPU's compiler must try several algorithms."""
    resumes: ClassVar[bool] = True
    """Whether its runs save checkpoints, from which they can be resumed."""
    squashes: ClassVar[bool] = False
    """Whether tanh brings its actions into [-1, 1]; else they are clipped."""

    def validate(self, env: GoalEnv, config: "Config") -> None:
        """Raises a ValueError if its sizes do not fit a task, or the other sizes; by default they do."""
        return

    def check_hyperparameters(self, config: "Config", hyper: "Hyperparameters") -> None:
        """Raises a ValueError if hyperparameters, none of them traced, contradict the sizes; by default none do."""
        return

    def with_bc(self, weight: float) -> "Learner":
        """Returns the learner with sizes for a BC loss of this weight; by default it needs none."""
        return self

    @abc.abstractmethod
    def init(self, env: GoalEnv, config: "Config", rngs: jax.Array) -> Any:
        """Returns the untrained networks and optimisers, from two PRNG keys, `[2]`."""

    def init_buffer(self, env: GoalEnv) -> Any:
        """Returns an empty replay buffer; None for a learner that uses each roll-out once."""
        return None

    @abc.abstractmethod
    def phase_updates(self) -> Mapping[Phase, Update]:
        """Returns the update of each phase that learns."""

    @abc.abstractmethod
    def policy(
        self, env: GoalEnv, config: "Config", state: "TrainState", noise: jax.Array | float, axis: str | None = None
    ) -> "Policy":
        """Returns the policy of `state`, to be rolled out, with a `noise` of 1 to explore or 0 for the mean action.

        The noise may be traced. In a device's part of the environments, by `axis` of `rollout`, the policy acts as it
        would in all of them.
        """

    def detour(self, env: GoalEnv, config: "Config", state: "TrainState", rng: jax.Array) -> "Detour | None":
        """Draws goals that the episodes of a roll-out to learn from pursue before their own; by default none do."""
        return None

    @abc.abstractmethod
    def progress(self, config: "Config", state: "TrainState") -> jax.Array:
        """Returns the fraction of the rounds that is done, `[]`."""

    @abc.abstractmethod
    def phase_table(self, config: "Config") -> np.ndarray:
        """Returns the phases of a whole run, integers `[rounds + 1, phases]`, each row ending with an evaluation."""

    @abc.abstractmethod
    def layers(self, state: "TrainState") -> list[tuple[jax.Array, ...]]:
        """Returns the layers of the mean action's network, as `MeanPolicy.layers` has them."""

    def camera_policy(self, env: GoalEnv, state: "TrainState") -> dict[str, Any]:
        """Returns the arrays of a `CameraPolicy`, by the names of its fields; for learners from pictures alone."""
        raise NotImplementedError


def check_sizes(sizes: Any, may_be_zero: tuple[str, ...] = ()) -> None:
    """Raises a ValueError for an `int` field that is no count from 1 (0 if `may_be_zero`), or a `bool` that is none."""
    for field in dataclasses.fields(sizes):
        value = getattr(sizes, field.name)
        if field.type is int:
            check_count(field.name, value, least=int(field.name not in may_be_zero))
        elif field.type is bool and not isinstance(value, bool):
            raise ValueError(f"{field.name} is {value!r}; it must be True or False")

"""The training state: everything that a round reads and writes, as one pytree."""

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from flax import struct

from hgail_envs.workarounds import promotion
from hgail_jax.config import Hyperparameters
from hgail_jax.policy import MAX_NORMALIZED

if TYPE_CHECKING:
    from hgail_jax.samples import Samples


class TrainState(struct.PyTreeNode):
    """Networks, optimisers, observation statistics, hyperparameters and the PRNG key."""

    learner: Any
    """Networks, optimisers and counters of the learner; see `hgail_jax.learner`."""
    discriminator: Any
    discriminator_optimizer: optax.OptState
    statistics: running_statistics.RunningStatisticsState
    """Mean and standard deviation of observations so far: the expert samples of the pre-training, and the policy's own
    in its updates."""
    hyperparameters: Hyperparameters
    rng: jax.Array
    expert: Any = None
    """Expert samples that are kept from roll-out to roll-out, see `hgail_jax.experts`; None where none are."""
    buffer: Any = None
    """Episodes of the last roll-outs, see `hgail_jax.buffer`; None where the learner uses each roll-out once."""

    def normalize(self, observation: jax.Array) -> jax.Array:
        """Standardises observations, `[..., observation_size]`, and clips them to ±5."""
        with promotion():
            return running_statistics.normalize(observation, self.statistics, max_abs_value=MAX_NORMALIZED)

    def count(self, samples: "Samples") -> "TrainState":
        """Counts samples into the statistics, each of them once, those of weight 0 not at all."""
        weight = (samples.weight > 0).astype(jnp.float32)
        with promotion():
            counted = running_statistics.update(self.statistics, samples.observation, weights=weight)
        return self.replace(statistics=counted)


class StateKeys(NamedTuple):
    """The parts that the key of a training state is split into, all by one split, so that no two of them ever meet."""

    following: jax.Array
    """Of the state after a phase that learns."""
    phase: jax.Array
    """Of the phase: its roll-out and its update."""
    evaluation: jax.Array
    """Of an evaluation between two phases."""
    final_evaluation: jax.Array
    """Of an evaluation once the training is over."""


def split_key(rng: jax.Array) -> StateKeys:
    """Splits the key of a training state.

    Deriving one of these by `jax.random.fold_in(rng, 1)` would not do: that is bit for bit the second half of
    `jax.random.split(rng)`, and evaluations would play the starts and goals of the next phase.
    """
    return StateKeys(*jax.random.split(rng, len(StateKeys._fields)))

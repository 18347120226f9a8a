"""Rounds and evaluations that need no compiler, for tests of what a run does with their results."""

import jax
import jax.numpy as jnp
import numpy as np

from hgail_jax import EpisodeMetrics, RoundMetrics
from hgail_jax.trainer import loop, training
from tests.support import init_once


def train_without_a_compiler(monkeypatch=None):
    """Has runs do rounds that draw their measurements and change all that is learnt by its key, which they change too.

    Equal states so give equal rounds, to the bit, and a state that differs anywhere stays another. Without
    `monkeypatch` it is for good, in a process of its own.
    """
    init_once(monkeypatch)
    change = setattr if monkeypatch is None else monkeypatch.setattr
    change(loop, "compile_train_step", lambda *_: _round)
    change(training, "trace_evaluation", lambda *_: lambda: _evaluate)


def _generators(states):
    return [np.random.default_rng(key) for key in np.asarray(jax.random.key_data(states.rng))]


def _episodes(generators):
    drawn = np.sort([generator.uniform(0.1, 0.9, 5) for generator in generators])
    return EpisodeMetrics(*drawn.T[[1, 2, 3, 4, 0]].astype(np.float32))


def _round(states, phases):
    generators = _generators(states)
    keys = np.array([generator.integers(2**32, size=2, dtype=np.uint32) for generator in generators])

    def moved(leaf):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            return leaf
        step = [0.01 * generator.normal(size=leaf.shape[1:]) for generator in generators]
        return jnp.asarray(np.asarray(leaf) + np.array(step, np.float32))

    parts = {name: jax.tree.map(moved, getattr(states, name)) for name in ("learner", "discriminator", "statistics")}
    update = {"reward": np.array([generator.normal() for generator in generators], np.float32)}
    zero = np.zeros(len(generators), np.float32)
    metrics = RoundMetrics(_episodes(generators), _episodes(generators), update, zero, zero, zero)
    return states.replace(rng=jax.random.wrap_key_data(keys), **parts), metrics


def _evaluate(states):
    """Returns measurements that differ with each number that was learnt."""
    learnt = [np.asarray(leaf) for leaf in jax.tree.leaves(states.learner)]
    seeds = [
        np.frombuffer(b"".join(leaf[seed].tobytes() for leaf in learnt), np.uint8) for seed in range(len(states.rng))
    ]
    return _episodes([np.random.default_rng(seed) for seed in seeds])

"""An update phase of the off-policy learner by parts, beside a bare optimiser loop on the same networks."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from experiments.bench.optimiser import bare_optimiser
from experiments.bench.timing import compile_timed
from experiments.bench.training import Training
from hgail_envs import EpisodeMetrics, GoalEnv
from hgail_jax.config import Config
from hgail_jax.learners.td3 import update
from hgail_jax.rollout import Trajectory
from hgail_jax.state import TrainState
from hgail_jax.train import Phase


class UpdateParts:
    """An update phase of TD3 and its parts, of seeds side by side, to be timed.

    Args:
      training: of a learner TD3.

    """

    def __init__(self, training: Training) -> None:
        workload, seeds = training.workload, training.seeds
        env, preset = workload.env, workload.preset
        self._env_steps = seeds * workload.env_steps
        sizes = env.observation_size, env.action_size
        self.calls = {
            "update_phase": training.call(Phase.POLICY),
            "rollout_phase": training.call(Phase.PRETRAIN),
            "gradient_steps": _gradient_steps(training, training.config.replace(discriminator_minibatches=0)),
            "bare_optimiser": bare_optimiser(*sizes, preset.config, preset.hyperparameters, seeds),
        }
        """Calls by name: a whole phase; one that only fills the buffer; the gradient steps of actor and critics, with
        the drawing of their samples; such steps bare; and, where there is a discriminator, its steps and theirs."""
        if training.config.discriminator_minibatches:
            self.calls["all_gradient_steps"] = _gradient_steps(training, training.config)

    def row(self, seconds: Mapping[str, float]) -> dict[str, float]:
        """Returns the row's columns from the seconds of each call."""
        whole, steps = seconds["update_phase"], seconds["gradient_steps"]
        alone = ("update_phase", "rollout_phase", "gradient_steps", "bare_optimiser")
        return {
            **{f"{name}_seconds": seconds[name] for name in alone},
            "discriminator_seconds": seconds.get("all_gradient_steps", steps) - steps,
            "gradient_steps_to_bare": seconds["bare_optimiser"] / steps,
            "update_env_steps_per_second": self._env_steps / whole,
        }


def update_fractions(row: Mapping[str, Any], stepping_seconds: float) -> dict[str, float]:
    """Returns the fractions of an update phase's time, which add up to 1; what no part has is the rest.

    Args:
      row: with the columns of `UpdateParts.row`.
      stepping_seconds: what the environments' steps alone take.

    """
    seconds = {
        "physics": stepping_seconds,
        "policy_and_bookkeeping": row["rollout_phase_seconds"] - stepping_seconds,
        "gradient_steps": row["gradient_steps_seconds"],
        "discriminator": row["discriminator_seconds"],
    }
    seconds["rest"] = row["update_phase_seconds"] - sum(seconds.values())
    return {f"share_{name}": taken / row["update_phase_seconds"] for name, taken in seconds.items()}


def _gradient_steps(training: Training, config: Config) -> Callable[[], Any]:
    """Returns a function that draws samples of the buffer and takes the gradient steps of `config` on them."""
    env = training.workload.env
    episode = _one_episode(env)  # whose place in the buffer costs nothing

    def steps(state: TrainState, rng: jax.Array) -> Any:
        state, metrics = update(env, config, state, episode, rng)
        return state.learner, state.discriminator, metrics

    arguments = training.states, jax.random.split(jax.random.key(0), training.seeds)
    compiled, _ = compile_timed(jax.vmap(steps), *arguments)
    return functools.partial(compiled, *arguments)


def _one_episode(env: GoalEnv) -> Trajectory:
    """Returns an episode of nothing but zeros."""
    states, steps = (env.episode_length + 1, 1), (env.episode_length, 1)
    return Trajectory(
        features=jnp.zeros((*states, env.feature_size)),
        achieved=jnp.zeros((*states, env.goal_size)),
        desired=jnp.zeros((*states, env.goal_size)),
        action=jnp.zeros((*steps, env.action_size)),
        log_prob=jnp.zeros(steps),
        reward=jnp.zeros(steps),
        valid=jnp.ones(1, bool),
        overflow=jnp.zeros(1, bool),
        outcome=EpisodeMetrics(),
    )

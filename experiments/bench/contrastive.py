"""JaxGCRL's contrastive learner, off-policy and with hindsight, on this project's Fetch tasks."""

import contextlib
import functools
import importlib.util
import sys
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State, Wrapper

import hgail_envs
from hgail_envs.fetch.arm import FetchEnv
from hgail_envs.validation import check_name

TASKS = ("reach", "push", "pick-and-place", "slide")
"""Tasks with positions as goals, which CRL needs."""
EPISODES = 256
"""Episodes of a test."""
_EPOCH_EPISODES = 4  # of each environment, from one test to the next
_PREFILL_EPISODES = 2  # likewise, before the first update
_MOST_TESTS = 100_000

# Modules that JaxGCRL 0.2.8 imports for annotations and logs, and that these versions of its packages lack.
_ABSENT: dict[str, dict[str, Any]] = {
    "brax.v1": {"envs": SimpleNamespace(Env=Env, State=State, Wrapper=Wrapper)},
    "wandb_osh": {},
    "wandb_osh.hooks": {"TriggerWandbSyncHook": object},
}

Tested = Callable[[int, float, float], bool]
"""Callback of each test: takes environment steps, seconds by JaxGCRL's clock and the success rate, and returns true to
end the training. The clock counts training and its compilation, without the tests and the roll-outs that prefill."""


class JaxGcrlTask(Env):
    """A Fetch task for JaxGCRL: an observation is a state and then the goal, which is a part of the state.

    The state is the task's observation without the goal, or the reference's where there is an object. The goal is the
    position of the gripper or of the object, `[3]`, metres. The reward is 1 at the goal, else 0.

    In training, brax's wrapper resets each environment to the start and goal of its first episode, as in JaxGCRL's own
    tasks.

    Args:
      task: reach, push, pick-and-place or slide.
      impl: see `FetchEnv`.
      substeps: likewise.
      worlds: likewise.

    Raises:
      ValueError: the task is not one of `TASKS`.

    """

    def __init__(self, task: str, impl: str, substeps: int, worlds: int) -> None:
        check_name("task", task, TASKS)
        of_object = task != "reach"
        options = {"observation": "official"} if of_object else {}
        env = hgail_envs.make(task, impl=impl, substeps=substeps, worlds=worlds, **options)
        assert isinstance(env, FetchEnv)
        self.env = env
        self.state_dim = env.feature_size
        self.goal_indices = np.arange(3, 6) if of_object else np.arange(3)
        """Indices in a state of the position that the goal is compared with."""
        self.goal_reach_thresh = env.success_threshold

    def reset(self, rng: jax.Array) -> State:
        """Starts an episode."""
        return self._seen(self.env.reset(rng), {})

    def step(self, state: State, action: jax.Array) -> State:
        """Takes one step."""
        return self._seen(self.env.step(state, action), state.metrics)

    def _seen(self, state: State, metrics: dict[str, jax.Array]) -> State:
        features, goal = state.info["features"], state.info["desired_goal"][:3]
        success = state.reward + 1.0
        told = {
            "reward": success,
            "success": success,
            "success_easy": success,
            "dist": jnp.linalg.norm(features[self.goal_indices] - goal),
            "distance_from_origin": jnp.zeros(()),
        }
        return state.replace(obs=jnp.concatenate([features, goal]), reward=success, metrics=metrics | told)

    @property
    def observation_size(self) -> int:
        """Numbers in an observation."""
        return self.state_dim + 3

    @property
    def action_size(self) -> int:
        """Numbers in an action."""
        return self.env.action_size

    @property
    def backend(self) -> str:
        """Name of the physics in brax."""
        return self.env.backend


class _Enough(Exception):
    """Ends a training from its callback."""


def train_contrastive(task: JaxGcrlTask, num_envs: int, seed: int, tested: Tested) -> None:
    """Trains with JaxGCRL's CRL in its own settings, testing the mean action now and then, until `tested` is true.

    Args:
      task: to learn.
      num_envs: environments, a multiple of 256.
      seed: of the training.
      tested: callback of each test.

    Raises:
      ImportError: JaxGCRL is not installed.

    """
    crl = _import_learner()
    learner = crl(unroll_length=task.env.episode_length, min_replay_size=_PREFILL_EPISODES * task.env.episode_length)

    @functools.partial(jax.jit, static_argnums=0)
    def test(make_policy: Callable, params: Any) -> jax.Array:
        policy = make_policy(params)
        return success_rate(task, lambda seen: jnp.tanh(policy(seen, None)[0]))

    def progress(
        env_steps: int, metrics: dict[str, Any], make_policy: Callable, params: Any, *_: Any, **__: Any
    ) -> None:
        seconds = float(metrics["training/walltime"])
        if tested(env_steps, seconds, float(test(make_policy, params))):
            raise _Enough

    with contextlib.suppress(_Enough):
        learner.train_fn(_run(task, num_envs, seed), task, task, progress_fn=progress)


def success_rate(task: JaxGcrlTask, act: Callable[[jax.Array], jax.Array]) -> jax.Array:
    """Returns the success rate at the last step of `EPISODES` episodes, `[]`.

    Args:
      task: the task.
      act: actions, `[..., action_size]`, for observations, `[..., observation_size]`.

    """

    def step(states: State, _: None) -> tuple[State, None]:
        return jax.vmap(task.step)(states, act(states.obs)), None

    states = jax.vmap(task.reset)(jax.random.split(jax.random.key(0), EPISODES))
    end, _ = jax.lax.scan(step, states, None, task.env.episode_length)
    return end.metrics["success"].mean()


def _run(task: JaxGcrlTask, num_envs: int, seed: int) -> SimpleNamespace:
    """Returns the settings of a run without an end of its own, tested every `_EPOCH_EPISODES` episodes."""
    length = task.env.episode_length
    return SimpleNamespace(
        seed=seed,
        num_envs=num_envs,
        episode_length=length,
        total_env_steps=num_envs * length * (_PREFILL_EPISODES + _EPOCH_EPISODES * _MOST_TESTS),
        num_evals=_MOST_TESTS,
        num_eval_envs=1,  # minimal: its own tests count the best step of an episode
        action_repeat=1,
        visualization_interval=_MOST_TESTS,
        checkpoint_logdir=None,
    )


def _import_learner() -> Any:
    for name, contents in _ABSENT.items():
        if name not in sys.modules and not _is_there(name):
            sys.modules[name] = ModuleType(name)
            vars(sys.modules[name]).update(contents)
    return importlib.import_module("jaxgcrl.agents").CRL


def _is_there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False

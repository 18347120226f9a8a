"""How large the paper's experiments are, by task and platform."""

import dataclasses
from typing import Any

import jax

import envs
from envs.fetch.arm import FetchEnv
from hgail_jax.config import PRESETS, Preset
from hgail_jax.presets import EVALUATION_EPISODES, defaults

_PER_ROLL_OUT = 4  # roll-outs' worth of episodes that the best-of buffer holds
_MOST_BEST = 1000  # as Guo et al. 2018 keep


@dataclasses.dataclass(frozen=True)
class Sizes:
    """What an experiment on a task starts from."""

    preset: Preset
    substeps: int
    """Physics steps per action in training, of the Fetch tasks."""
    evaluation_episodes: int
    """Episodes per seed that the final evaluation has at least."""


_QUICK = {
    "num_envs": 4,
    "rounds": 1,
    "ppo_minibatches": 2,
    "discriminator_minibatches": 2,
    "discriminator_batch": 16,
    "pretrain_policy_minibatches": 5,
    "pretrain_policy_batch": 16,
    "pretrain_discriminator_minibatches": 5,
}
_QUICK_EVALUATION_EPISODES = 8


def sizes(task: str, platform: str, quick: bool = False, preset: str = "parallel") -> Sizes:
    """Returns the sizes of a task on `"cpu"` or `"gpu"`; `quick` ones show that everything runs, and nothing else."""
    base = PRESETS[preset]
    config: dict[str, Any] = {}
    hyperparameters: dict[str, Any] = {}
    default = defaults(envs.find_class(task), platform)
    if preset == "parallel":
        config, hyperparameters = default.config, default.hyperparameters
    config = config | (_QUICK if quick else {})
    config = config | {"best_episodes": min(_MOST_BEST, _PER_ROLL_OUT * config.get("num_envs", base.config.num_envs))}
    return Sizes(
        Preset(dataclasses.replace(base.config, **config), base.hyperparameters.replace(**hyperparameters)),
        default.substeps,
        _QUICK_EVALUATION_EPISODES if quick else EVALUATION_EPISODES[platform],
    )


def make_env(task: str, platform: str, worlds: int) -> envs.GoalEnv:
    """Makes a task with the physics that it is trained in, for so many environments at once."""
    if issubclass(envs.find_class(task), FetchEnv):
        return envs.make(task, substeps=sizes(task, platform).substeps, worlds=worlds)
    return envs.make(task)


def platform_name() -> str:
    """Returns what JAX runs on: `"cpu"` or `"gpu"`."""
    return "cpu" if jax.default_backend() == "cpu" else "gpu"

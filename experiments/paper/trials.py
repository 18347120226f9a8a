"""Trials: settings resolved for a task and a platform."""

import dataclasses
import json
from hashlib import sha256
from typing import Any

import hgail_envs
from experiments import FEW_UPDATES
from experiments.paper.study import Setting
from hgail_envs.engines import resolve_impl
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.learners import PPO
from hgail_jax.settings.defaults import EVALUATION_EPISODES, task_preset
from hgail_jax.settings.methods import METHODS
from hgail_jax.settings.presets import Preset
from hgail_jax.train import env_steps, phase_table

FEW_ROUNDS = 100
"""Most rounds of a training that is evaluated in every round."""

_PER_ROLL_OUT = 4  # roll-outs whose episodes fill the best-of buffer
_MOST_BEST = 1000  # as Guo et al. 2018 keep

_FEW_EPISODES: dict[str, Any] = {"num_envs": 4, "rounds": 1}
_FEW_STEPS: dict[str, Any] = _FEW_EPISODES | {"rollouts": 1, "updates": 2, "batch": 16, "buffer_episodes": 8}
_QUICK: dict[str, dict[str, Any]] = {
    "ppo": FEW_UPDATES | _FEW_EPISODES,
    "td3": _FEW_STEPS | {"discriminator_minibatches": 2, "discriminator_batch": 16},
    "crl": _FEW_STEPS,
}
_QUICK_EVALUATION_EPISODES = 8


@dataclasses.dataclass(frozen=True)
class Scale:
    """Sizes of the experiments on a task."""

    task: str
    platform: str
    """`"cpu"` or `"gpu"`."""
    quick: bool = False
    """Takes tiny sizes that show that everything runs."""

    @property
    def task_class(self) -> type[hgail_envs.GoalEnv]:
        """The task."""
        return hgail_envs.find_class(self.task)

    @property
    def evaluation_episodes(self) -> int:
        """Least episodes per seed of the final evaluation."""
        return _QUICK_EVALUATION_EPISODES if self.quick else EVALUATION_EPISODES[self.platform]

    @property
    def task_options(self) -> dict[str, Any]:
        """Options of the task's class in training, e.g. `substeps` of the Fetch tasks."""
        return dict(task_preset(self.task_class, self.platform).task_options)

    def preset(self, name: str = "parallel", learner: str = PPO.name) -> Preset:
        """Returns the preset that settings change."""
        preset = task_preset(self.task_class, self.platform, name, learner)
        config = preset.config.replace(**(_QUICK[learner] if self.quick else {}))
        config = config.replace(best_episodes=min(_MOST_BEST, _PER_ROLL_OUT * config.num_envs))
        return dataclasses.replace(preset, config=config)

    def make_env(self, worlds: int, **options: Any) -> hgail_envs.GoalEnv:
        """Makes the task with its training physics.

        Args:
          worlds: environments stepped at once.
          options: of the task's class, in place of the training's.
        """
        options = self.task_options | options
        if "worlds" in hgail_envs.accepted_options(self.task):
            options["worlds"] = worlds
        return hgail_envs.make(self.task, **options)


@dataclasses.dataclass(frozen=True)
class Trial:
    """A setting resolved for a task and a platform: all inputs of the computation."""

    task: str
    setting: Setting
    method: str
    config: Config
    hyperparameters: Hyperparameters
    seeds: range
    task_options: dict[str, Any]
    evaluation_episodes: int
    demonstrations_sha256: str | None
    usual_evaluate_every: int = 1
    """Rounds from one evaluation to the next in the task's own training."""

    def identity(self) -> dict[str, Any]:
        """Returns all inputs that decide the results, as plain JSON."""
        physics = {"impl": resolve_impl("auto")} if "impl" in hgail_envs.accepted_options(self.task) else {}
        identity = {
            "task": self.task,
            "method": self.method,
            "seeds": list(self.seeds),
            "evaluation_episodes": self.evaluation_episodes,
            "physics": physics | self.task_options,
            "demonstrations": self.demonstrations_sha256,
            "config": self.config.as_dict(),
            "hyperparameters": self.hyperparameters.as_dict(),
        }
        return json.loads(json.dumps(identity))

    @property
    def evaluate_every(self) -> int:
        """Rounds from one evaluation to the next: the task's, or k in a long training of k times the steps.

        Long is more than `FEW_ROUNDS`. An evaluation costs as much as a training roll-out, and changes nothing.
        """
        multiple = int(self.setting.steps_on(self.task)) if self.config.rounds + 1 > FEW_ROUNDS else 1
        return max(self.usual_evaluate_every, multiple)

    def key(self) -> str:
        """Returns a hash of the identity."""
        return hash_json(self.identity())


def hash_json(content: Any) -> str:
    """Returns the first 16 hexadecimal digits of the SHA-256 of `content` as JSON."""
    return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def work_out(scale: Scale, setting: Setting, seeds: range, demonstrations_sha256: str | None = None) -> Trial:
    """Resolves a setting into a trial.

    It has `setting.steps` times the default environment steps of HGAIL with that learner, rounded to whole rounds.

    Args:
      scale: the task and its sizes.
      setting: to resolve.
      seeds: the seeds; see `choose_seeds`.
      demonstrations_sha256: hash of the demonstrations, if the setting has any.
    """
    env = scale.task_class
    usual = scale.preset(setting.preset, setting.learner)
    method = setting.method or usual.method
    base = METHODS[method].apply(usual)
    config = base.config.replace(**setting.config)
    if "rounds" not in setting.config:
        wanted = setting.steps_on(scale.task) * _steps(env, scale.preset(learner=setting.learner).config)
        before = _steps(env, config.replace(rounds=0))
        each = _steps(env, config.replace(rounds=1)) - before
        config = config.replace(rounds=max(round((wanted - before) / each), 1))
    return Trial(
        task=scale.task,
        setting=setting,
        method=method,
        config=config,
        hyperparameters=base.hyperparameters.replace(**setting.hyperparameters).validate(config=config),
        seeds=seeds,
        task_options=dict(base.task_options) | setting.task_options,
        evaluation_episodes=scale.evaluation_episodes,
        demonstrations_sha256=demonstrations_sha256,
        usual_evaluate_every=base.evaluate_every,
    )


def _steps(env: Any, config: Config) -> int:
    return int(env_steps(env, config, phase_table(config)).sum())

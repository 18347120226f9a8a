"""A setting worked out for a task and a platform: all that decides what is computed."""

import dataclasses
import json
from hashlib import sha256
from typing import Any

import hgail_envs
from experiments.paper.study import Setting
from hgail_envs.engines import resolve_impl
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.defaults import EVALUATION_EPISODES, FEW_UPDATES, Preset, task_preset
from hgail_jax.methods import METHODS
from hgail_jax.train import env_steps, phase_table

FEW_ROUNDS = 100
"""Up to so many rounds a setting is evaluated in every one of them."""

_PER_ROLL_OUT = 4  # roll-outs' worth of episodes that the best-of buffer holds
_MOST_BEST = 1000  # as Guo et al. 2018 keep

_QUICK: dict[str, Any] = FEW_UPDATES | {"num_envs": 4, "rounds": 1}
_QUICK_EVALUATION_EPISODES = 8


@dataclasses.dataclass(frozen=True)
class Scale:
    """How large the experiments on a task are."""

    task: str
    platform: str
    """`"cpu"` or `"gpu"`."""
    quick: bool = False
    """Takes sizes that show that everything runs, and nothing else."""

    @property
    def task_class(self) -> type[hgail_envs.GoalEnv]:
        """The task."""
        return hgail_envs.find_class(self.task)

    @property
    def evaluation_episodes(self) -> int:
        """Episodes per seed that the final evaluation has at least."""
        return _QUICK_EVALUATION_EPISODES if self.quick else EVALUATION_EPISODES[self.platform]

    @property
    def task_options(self) -> dict[str, Any]:
        """Options of the task's class in training, e.g. `substeps` of the Fetch tasks."""
        return dict(task_preset(self.task_class, self.platform).task_options)

    def preset(self, name: str = "parallel") -> Preset:
        """Returns what a setting starts from."""
        preset = task_preset(self.task_class, self.platform, name)
        config = preset.config.replace(**(_QUICK if self.quick else {}))
        config = config.replace(best_episodes=min(_MOST_BEST, _PER_ROLL_OUT * config.num_envs))
        return dataclasses.replace(preset, config=config)

    def make_env(self, worlds: int, **options: Any) -> hgail_envs.GoalEnv:
        """Makes the task with the physics that it is trained in, for so many environments at once.

        Args:
          worlds: environments that are stepped at once.
          options: of the task's class, in place of those of its training.

        """
        options = self.task_options | options
        if "worlds" in hgail_envs.accepted_options(self.task):
            options["worlds"] = worlds
        return hgail_envs.make(self.task, **options)


@dataclasses.dataclass(frozen=True)
class Trial:
    """A setting worked out for a task and a platform: all that decides what is computed."""

    task: str
    setting: Setting
    config: Config
    hyperparameters: Hyperparameters
    seeds: range
    task_options: dict[str, Any]
    evaluation_episodes: int
    demonstrations_sha256: str | None
    usual_evaluate_every: int = 1
    """Rounds from one evaluation to the next in the task's own training."""

    def identity(self) -> dict[str, Any]:
        """Returns, as JSON has it, what another computation of the same results shares with this one."""
        physics = {"impl": resolve_impl("auto")} if "impl" in hgail_envs.accepted_options(self.task) else {}
        identity = {
            "task": self.task,
            "method": self.setting.method,
            "seeds": list(self.seeds),
            "evaluation_episodes": self.evaluation_episodes,
            "physics": physics | self.task_options,
            "demonstrations": self.demonstrations_sha256,
            "config": self.config.as_dict(),
            "hyperparameters": self.hyperparameters.as_dict(self.config.learner),
        }
        return json.loads(json.dumps(identity))

    @property
    def evaluate_every(self) -> int:
        """Rounds from one evaluation to the next: the task's, or k in a setting of k times the steps and many rounds.

        An evaluation costs as much as a roll-out to learn from, and changes nothing in the training. Many are more than
        `FEW_ROUNDS`.
        """
        multiple = int(self.setting.steps_on(self.task)) if self.config.rounds + 1 > FEW_ROUNDS else 1
        return max(self.usual_evaluate_every, multiple)

    def key(self) -> str:
        """Returns a hash of the identity."""
        return hash_json(self.identity())


def hash_json(content: Any) -> str:
    """Returns the first 16 hexadecimal digits of the SHA-256 of what JSON makes of `content`."""
    return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def work_out(scale: Scale, setting: Setting, seeds: range, demonstrations_sha256: str | None = None) -> Trial:
    """Returns a setting as it is trained.

    It takes `setting.steps` times the environment steps that HGAIL takes by default, to the nearest whole round.

    Args:
      scale: the task and its sizes.
      setting: what to work out.
      seeds: the seeds; see `choose_seeds`.
      demonstrations_sha256: what the demonstrations are, where the setting has any.

    """
    env = scale.task_class
    base = METHODS[setting.method].apply(scale.preset(setting.preset))
    config = base.config.replace(**setting.config)
    if "rounds" not in setting.config:
        wanted = setting.steps_on(scale.task) * _steps(env, scale.preset().config)
        before = _steps(env, config.replace(rounds=0))
        each = _steps(env, config.replace(rounds=1)) - before
        config = config.replace(rounds=max(round((wanted - before) / each), 1))
    return Trial(
        task=scale.task,
        setting=setting,
        config=config,
        hyperparameters=base.hyperparameters.replace(**setting.hyperparameters).validate(),
        seeds=seeds,
        task_options=scale.task_options | setting.task_options,
        evaluation_episodes=scale.evaluation_episodes,
        demonstrations_sha256=demonstrations_sha256,
        usual_evaluate_every=base.evaluate_every,
    )


def _steps(env: Any, config: Config) -> int:
    return int(env_steps(env, config, phase_table(config)).sum())

"""A run: all settings of a training, checked."""

import dataclasses
import time
from typing import Any

from jax.sharding import Mesh

import hgail_envs
from hgail_jax.config import Config, Hyperparameters
from hgail_jax.io.demonstrations import Demonstrations
from hgail_jax.trainer.loop import Program


@dataclasses.dataclass(frozen=True)
class Run:
    """Several seeds of one method on one task."""

    task: str
    method: str
    seeds: int
    first_seed: int
    env: hgail_envs.GoalEnv
    task_options: dict[str, Any]
    """Options of the task's class but those of its physics, as given or by default."""
    config: Config
    hyperparameters: Hyperparameters
    evaluation_episodes: int
    """Least number of episodes per seed in the final evaluation."""
    checkpoint_every: int
    """Rounds from one checkpoint to the next."""
    mesh: Mesh
    """Devices to train on; results do not depend on them."""
    demonstrations: Demonstrations | None = None
    """Demonstrations that the method learns from, if it does."""
    evaluate_every: int = 1
    """Rounds from one evaluation to the next."""
    loggers: tuple[str, ...] = ("csv",)
    """Names of `hgail_jax.trainer.loggers.LOGGERS`."""
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """The options as they were given."""
    started: float = dataclasses.field(default_factory=time.perf_counter)
    """Reading of `time.perf_counter` from which the run's total time counts."""

    def identity(self) -> dict[str, Any]:
        """Returns the settings that a run must have in common with one that it resumes."""
        return {
            **{name: getattr(self, name) for name in ("task", "method", "seeds", "first_seed")},
            "physics": {name: getattr(self.env, name, None) for name in ("impl", "substeps")} | self._randomization(),
            "task_options": self.task_options,
            "config": self.config.as_dict(),
            "hyperparameters": self.hyperparameters.as_dict(self.config.learner),
            "demonstrations": None if self.demonstrations is None else self.demonstrations.sha256,
        }

    def _randomization(self) -> dict[str, Any]:
        """Returns the sizes of the randomisation; nothing if there is none, as older runs have it."""
        randomization = getattr(self.env, "randomization", None)
        return {} if randomization is None else {"randomization": randomization.as_dict()}

    def program(self) -> Program:
        """Returns the program to compile."""
        return Program(
            env=self.env,
            config=self.config,
            settings=(self.hyperparameters,),
            seeds=self.seeds,
            first_seed=self.first_seed,
            demonstrations=None if self.demonstrations is None else self.demonstrations.samples(self.env),
            mesh=self.mesh,
            evaluate_every=self.evaluate_every,
        )

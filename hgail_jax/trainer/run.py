"""A run: everything that decides what a training computes, checked and worked out."""

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
    """The options of its own that the task was given."""
    config: Config
    hyperparameters: Hyperparameters
    evaluation_episodes: int
    """Episodes per seed that the final evaluation has at least."""
    checkpoint_every: int
    """Rounds from one checkpoint to the next."""
    mesh: Mesh
    """The devices to train on; what is computed does not depend on them."""
    demonstrations: Demonstrations | None = None
    """Where the method learns from any."""
    evaluate_every: int = 1
    """Rounds from one evaluation to the next."""
    loggers: tuple[str, ...] = ("csv",)
    """Where measurements go: names of `hgail_jax.trainer.loggers.LOGGERS`."""
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """The options as they were given."""
    started: float = dataclasses.field(default_factory=time.perf_counter)
    """Reading of `time.perf_counter` from which the run's total time counts."""

    def identity(self) -> dict[str, Any]:
        """Returns what a run that resumes another must share with it."""
        return {
            **{name: getattr(self, name) for name in ("task", "method", "seeds", "first_seed")},
            "physics": {name: getattr(self.env, name, None) for name in ("impl", "substeps")} | self._randomization(),
            "task_options": self.task_options,
            "config": self.config.as_dict(),
            "hyperparameters": dataclasses.asdict(self.hyperparameters),
            "demonstrations": None if self.demonstrations is None else self.demonstrations.sha256,
        }

    def _randomization(self) -> dict[str, Any]:
        """Returns the sizes of the disturbances; nothing where there are none, as before there could be any."""
        randomization = getattr(self.env, "randomization", None)
        return {} if randomization is None else {"randomization": dataclasses.asdict(randomization)}

    def program(self) -> Program:
        """Returns what is to be compiled."""
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

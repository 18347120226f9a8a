"""A run: all settings of a training, checked."""

import dataclasses
import hashlib
import time
from pathlib import Path
from typing import Any

from jax.sharding import Mesh

from hgail_envs.engines.c import digest
from hgail_envs.randomized import RandomizedEnv
from hgail_envs.robots.description import is_file, text_of
from hgail_envs.vision.camera_env import CameraEnv
from hgail_jax.config import Hyperparameters
from hgail_jax.trainer.checkpoint import LOOK_SIZES
from hgail_jax.trainer.loop import Program
from hgail_jax.vision.policy import sizes_of_look


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run(Program):
    """Several seeds of one method on one task: a program of one setting, and its results."""

    task: str
    method: str
    mesh: Mesh
    """Devices to train on; results do not depend on them."""
    task_options: dict[str, Any]
    """Options of the task's class but those of its physics, as given or by default."""
    evaluation_episodes: int
    """Least number of episodes per seed in the final evaluation."""
    checkpoint_every: int
    """Rounds from one checkpoint to the next."""
    demonstrations_sha256: str | None = None
    """Hash of the demonstrations that the method learns from, if it does."""
    teacher: Path | None = None
    """File of the policy that teaches a student."""
    loggers: tuple[str, ...] = ("csv",)
    """Names of `hgail_jax.trainer.loggers.LOGGERS`."""
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """The options as they were given."""
    started: float = dataclasses.field(default_factory=time.perf_counter)
    """Reading of `time.perf_counter` from which the run's total time counts."""

    @property
    def hyperparameters(self) -> Hyperparameters:
        """Its one setting."""
        return self.settings[0]

    def identity(self) -> dict[str, Any]:
        """Returns the settings that a run must have in common with one that it resumes."""
        physics: dict[str, Any] = {name: getattr(self.env, name, None) for name in ("impl", "substeps")}
        if is_file(robot := str(self.task_options.get("robot"))):  # which may have been changed by hand
            digest_of_both = hashlib.sha256((text_of(robot) + digest(self.env.robot.model)).encode()).hexdigest()
            physics["description and model of the robot"] = digest_of_both[:8]
        if isinstance(self.env, RandomizedEnv):
            physics["randomization"] = dataclasses.asdict(self.env.randomization)
        if isinstance(self.env, CameraEnv):
            pictures = self.env.pictures
            physics["pictures"] = {
                "cameras": list(pictures.cameras),
                **{name: getattr(pictures, name) for name in ("size", "look", "renderer", "target")},
                **({} if pictures.kind == "colour" else {"kind": pictures.kind}),  # older runs do not say it
                LOOK_SIZES: sizes_of_look(pictures.look, pictures.kind),
                "teacher": self.teacher and hashlib.sha256(self.teacher.read_bytes()).hexdigest(),
            }
        return {
            **{name: getattr(self, name) for name in ("task", "method", "seeds", "first_seed")},
            "physics": physics,
            "task_options": self.task_options,
            "config": self.config.as_dict(),
            "hyperparameters": self.hyperparameters.as_dict(),
            "demonstrations": self.demonstrations_sha256,
        }

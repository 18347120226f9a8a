"""The trainer: a run in its folder, as a notebook uses it."""

import dataclasses
import threading
from pathlib import Path
from typing import Any

from hgail_envs.validation import plain_number
from hgail_jax.defaults import platform_name
from hgail_jax.io.policy import MeanPolicy, load_policy
from hgail_jax.trainer.folder import open_run_folder
from hgail_jax.trainer.options import TrainOptions, plan
from hgail_jax.trainer.run import Run
from hgail_jax.trainer.training import train_run


class Trainer:
    """Trains a run and keeps its folder.

        trainer = Trainer(task="reach", seeds=2)
        summary = trainer.train()
        action = trainer.policy(seed=0)(observation)

    Nothing is written before `train`. A training that was stopped goes on, in this process or another, with
    `resume=trainer.folder`, and ends with the bits of one that was not. Of several processes that train together each
    has a trainer; the first writes the folder.

    Args:
      options: settings of the run.
      **changes: fields of `TrainOptions` that differ from `options`.

    Raises:
      ValueError: an option has a value that it cannot have.

    """

    def __init__(self, options: TrainOptions | None = None, **changes: Any) -> None:
        given = dataclasses.replace(options or TrainOptions(), **changes)
        numbers = {field.name: plain_number(getattr(given, field.name)) for field in dataclasses.fields(given)}
        self.options = dataclasses.replace(given, **numbers)
        self.run: Run = plan(self.options, platform_name())
        self._folder: Path | None = None

    @property
    def folder(self) -> Path:
        """The run's folder."""
        if self._folder is None:
            raise ValueError("the run has no folder yet; train it")
        return self._folder

    def policy(self, seed: int) -> MeanPolicy:
        """Returns the trained policy of a seed.

        Raises:
          FileNotFoundError: it is not trained yet, or not by this run.

        """
        return load_policy(self.folder / "policies" / f"seed-{seed}.npz")

    def train(self, stop: threading.Event | None = None) -> dict[str, Any] | None:
        """Trains and evaluates all seeds, and writes everything into the folder; see `train_run`.

        Raises:
          ValueError: the folder, or its checkpoints, cannot be used.

        """
        with open_run_folder(self.run, self.options.out, self.options.resume) as folder:
            self._folder = folder.path
            return train_run(self.run, folder, stop)

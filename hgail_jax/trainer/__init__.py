"""Trains seeds of a method on a task and keeps a folder of them: checkpoints, tables, curves, policies.

A run goes through these modules: `options` (plans it), `folder` (opens its folder), `training` (one run, and the
`Trainer`), `loop` (the rounds, with `checkpoint` and `loggers`), `results` (policies, curves and the summary).
"""

from hgail_jax.trainer.train_options import TrainOptions
from hgail_jax.trainer.training import Trainer

__all__ = ["TrainOptions", "Trainer"]

"""Trains seeds of a method on a task and keeps a folder of them: checkpoints, tables, curves, policies.

    from hgail_jax import Trainer

    trainer = Trainer(task="reach", seeds=2)
    summary = trainer.train()

A run goes through these modules: `options` (plans it), `folder` (opens its folder), `training` (one run), `loop`
(the rounds, with `checkpoint` and `loggers`), `results` (policies, `curves` and the summary).
"""

from hgail_jax.trainer.options import TrainOptions
from hgail_jax.trainer.training import Trainer

__all__ = ["TrainOptions", "Trainer"]

"""Trains seeds of a method on a task and keeps a folder of them: checkpoints, tables, curves, policies.

    from hgail_jax import Trainer

    trainer = Trainer(task="reach", seeds=2)
    summary = trainer.train()

The parts: `options` (what may be asked for), `run` (what that comes to), `loop` (the rounds), `checkpoint`,
`run_folder`, `results`, `curves`, `provenance` (what made a result) and `signals`.
"""

from hgail_jax.trainer.options import TrainOptions
from hgail_jax.trainer.trainer import Trainer

__all__ = ["TrainOptions", "Trainer"]

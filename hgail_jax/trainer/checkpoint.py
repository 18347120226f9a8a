"""Checkpoints: the whole state of a run on disk, written beside the training and checked when read."""

import contextlib
import hashlib
import json
import logging
import os
import re
import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from hgail_jax.devices.sharding import is_first_process
from hgail_jax.trainer.folder import AnotherRunError, as_json, refuse_another_run

# orbax tells of each write over several lines; its errors are raised as well.
logging.getLogger("absl").addFilter(lambda record: "orbax" not in record.pathname)

SCHEMA = 1
"""Version of what a checkpoint holds; one of another schema is refused."""
KEPT = 3
"""The last checkpoints that are kept, besides the best."""


class Checkpoint(NamedTuple):
    """A checkpoint as read."""

    rounds: int
    """Rounds done."""
    state: Any
    """The training state, arrays placed as the template's are."""
    record: dict
    """What was saved beside the state."""
    damaged: tuple[str, ...]
    """A line for each later checkpoint that could not be read."""


class Checkpoints:
    """The checkpoints of one run: `folder/<rounds done>`, of which the last `KEPT` and the best are kept.

    Arrays are stored whole and by name, each with a hash, so that a state can be restored onto any number of devices
    and damage is noticed. Nothing in them is code. Leaving the context waits for what is being written. Of several
    processes that train together only the first writes and reads.

    Args:
      folder: made with the first checkpoint.
      run: what identifies the run, as JSON has it; a checkpoint of another run is refused.

    Raises:
      ValueError: what has the folder's name is none.

    """

    def __init__(self, folder: Path | str, run: dict) -> None:
        if os.path.lexists(folder) and not os.path.isdir(folder):
            raise ValueError(f"{folder} is no folder, so that no checkpoints can be in it")
        self.folder = Path(folder).resolve()
        self.saved: int | None = None
        """Rounds done in the checkpoint saved last or restored."""
        self._run = as_json(run)
        self._scores: dict[str, list[float]] = {}  # by rounds done
        self._manager: ocp.CheckpointManager | None = None

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, *exception) -> None:
        if self._manager is not None:
            with self._one_error():
                self._manager.close()

    def save(self, rounds: int, state: Any, record: dict, score: Sequence[float] | None) -> None:
        """Copies a state and writes it in the background, under a name that it gets once it is whole.

        Args:
          rounds: rounds done, more than in any checkpoint before.
          state: any pytree of arrays and PRNG keys; it may be donated once this returns.
          record: anything that JSON can hold.
          score: the checkpoint whose score is largest, in the order of tuples, is the best; one that has none never is.

        Raises:
          FloatingPointError: the state is not finite. Nothing is written.
          OSError: this checkpoint, or the one before it, cannot be written. Nothing has its name, and what was written
            of it is removed, now or with the next checkpoint.
          ValueError: the folder holds checkpoints already and none was restored.

        """
        if self.saved is None and self._rounds_on_disk():
            raise ValueError(f"{self.folder} holds checkpoints; restore one before saving more")
        arrays = _to_arrays(state)
        for name, array in arrays.items():
            if np.issubdtype(array.dtype, np.inexact) and not np.isfinite(array).all():
                raise FloatingPointError(f"{name} is not finite")
        scores = dict(self._scores)
        if score is not None:
            scores[str(rounds)] = [float(value) for value in score]
        if not is_first_process():
            self.saved = rounds
            return
        body = {"schema": SCHEMA, "run": self._run, "rounds": rounds, "scores": scores, "record": as_json(record)}
        body["arrays"] = {name: _describe(array) for name, array in arrays.items()}
        with self._one_error():
            if self._manager is None:
                self._manager = self._open()
            self._scores = scores
            self._manager.save(
                rounds,
                args=ocp.args.Composite(
                    state=ocp.args.StandardSave(arrays),
                    record=ocp.args.JsonSave({"body": body, "sha256": _hash_json(body)}),
                ),
            )
        self.saved = rounds

    def restore(self, template: Any) -> Checkpoint | None:
        """Reads the latest checkpoint that is whole, or None where there is none; writes nothing.

        Args:
          template: a pytree of arrays, or of `jax.ShapeDtypeStruct`, like the state that was saved.

        Raises:
          AnotherRunError: the checkpoint is of another run or schema.
          ValueError: there are checkpoints, and none can be read.

        """
        damaged: list[str] = []
        for rounds in self._rounds_on_disk():
            try:
                body = self._read_body(rounds)
                self._refuse_others(body, template)
                if body.get("rounds", rounds) != rounds:
                    raise ValueError(f"it was renamed; it is checkpoint {body['rounds']}")
                arrays = self._read_arrays(rounds, body["arrays"])
            except AnotherRunError:
                raise
            except Exception as error:  # json, orbax and tensorstore raise what they like
                damaged.append(f"checkpoint {rounds} in {self.folder} is damaged: {_reason(error)}")
                continue
            self._scores, self.saved = body["scores"], rounds
            return Checkpoint(rounds, _from_arrays(arrays, template), body["record"], tuple(damaged))
        if damaged:
            raise ValueError(f"no checkpoint can be read: {'; '.join(damaged)}")
        return None

    def _rounds_on_disk(self) -> list[int]:
        """Rounds done in the checkpoints that have their name, latest first."""
        names = [path.name for path in self.folder.iterdir()] if self.folder.is_dir() else []
        return sorted((int(name) for name in names if re.fullmatch("0|[1-9][0-9]*", name)), reverse=True)

    def _open(self) -> ocp.CheckpointManager:
        for rounds in self._rounds_on_disk():
            if self.saved is not None and rounds > self.saved:  # damaged; training comes by again
                shutil.rmtree(self.folder / str(rounds))
        options = ocp.CheckpointManagerOptions(
            preservation_policy=_LastAndBest(self),
            cleanup_tmp_directories=True,
            enable_background_delete=False,
            create=False,
            multiprocessing_options=_alone(),
        )
        self.folder.mkdir(parents=True, exist_ok=True)
        return ocp.CheckpointManager(self.folder, options=options)

    def _read_body(self, rounds: int) -> dict:
        with ocp.Checkpointer(ocp.CompositeCheckpointHandler(), multiprocessing_options=_alone()) as reader:
            content = reader.restore(self.folder / str(rounds), args=ocp.args.Composite(record=ocp.args.JsonRestore()))
        record = content["record"]
        if _hash_json(record["body"]) != record["sha256"]:
            raise ValueError("its record was altered")
        return record["body"]

    def _refuse_others(self, body: dict, template: Any) -> None:
        if body["schema"] != SCHEMA:
            raise AnotherRunError(
                f"{self.folder} has checkpoints of schema {body['schema']}; this version reads {SCHEMA}"
            )
        refuse_another_run(self.folder, body["run"], self._run)
        there = {name: [described["dtype"], described["shape"]] for name, described in body["arrays"].items()}
        here = {name: [str(leaf.dtype), list(leaf.shape)] for name, leaf in _named(jax.eval_shape(_raw, template))}
        refuse_another_run(self.folder, there, here)

    def _read_arrays(self, rounds: int, described: dict) -> dict[str, np.ndarray]:
        """Reads the arrays one by one: reads that go on beside one that failed would complain on stderr."""
        arrays = {}
        handler = ocp.CompositeCheckpointHandler(state=ocp.PyTreeCheckpointHandler())
        with ocp.Checkpointer(handler, multiprocessing_options=_alone()) as reader:
            for name, entry in described.items():
                part = ocp.args.PyTreeRestore(
                    {name: np.empty(entry["shape"], entry["dtype"])},
                    restore_args={name: ocp.RestoreArgs(restore_type=np.ndarray)},
                    partial_restore=True,
                )
                content = reader.restore(self.folder / str(rounds), args=ocp.args.Composite(state=part))
                arrays[name] = content["state"][name]
                if _describe(arrays[name]) != entry:
                    raise ValueError(f"{name} is not what was saved")
        return arrays

    @contextlib.contextmanager
    def _one_error(self) -> Iterator[None]:
        """Turns whatever a failed write raises into an OSError, and removes what it left."""
        try:
            yield
        except Exception as error:
            self._remove_unfinished()
            raise OSError(f"cannot write a checkpoint to {self.folder}: {_reason(error)}") from error

    def _remove_unfinished(self) -> None:
        """Removes what has no name yet until nothing comes any more: one array failed, others are on their way."""
        quiet = 0
        for _ in range(100):
            unfinished = list(self.folder.glob("*orbax-checkpoint-tmp*"))
            for path in unfinished:
                shutil.rmtree(path, ignore_errors=True)
            quiet = 0 if unfinished else quiet + 1
            if quiet == 10:
                break
            time.sleep(0.05)


def _alone() -> ocp.options.MultiprocessingOptions:
    """Keeps orbax from waiting for processes other than the first, which know of no checkpoints."""
    if jax.process_count() == 1:
        return ocp.options.MultiprocessingOptions()
    return ocp.options.MultiprocessingOptions(primary_host=0, active_processes={0})


class _LastAndBest:
    """What orbax asks which checkpoints to keep."""

    def __init__(self, checkpoints: Checkpoints) -> None:
        self._checkpoints = checkpoints

    def should_preserve(self, checkpoints, *, context) -> list[bool]:
        del context
        scores = self._checkpoints._scores
        best = max(checkpoints, key=lambda info: (scores.get(str(info.step), []), info.step), default=None)
        last = checkpoints[-KEPT:]
        return [info is best or info in last for info in checkpoints]


def _raw(state: Any) -> Any:
    """Replaces PRNG keys by their numbers."""
    return jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, state)


def _is_key(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _named(tree: Any) -> list[tuple[str, Any]]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in leaves]


def _to_arrays(state: Any) -> dict[str, np.ndarray]:
    # Copied, as the arrays may be donated to the next step while they are being written.
    return {name: np.array(leaf, copy=True) for name, leaf in _named(_raw(state))}


def _from_arrays(arrays: dict[str, np.ndarray], template: Any) -> Any:
    def place(leaf: Any, array: np.ndarray) -> jax.Array:
        value = jax.random.wrap_key_data(jnp.asarray(array)) if _is_key(leaf) else array
        return jax.device_put(value, getattr(leaf, "sharding", None), may_alias=False)

    leaves, structure = jax.tree.flatten(template)
    values = [place(leaf, arrays[name]) for leaf, (name, _) in zip(leaves, _named(template), strict=True)]
    return jax.tree.unflatten(structure, values)


def _describe(array: np.ndarray) -> dict:
    digest = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
    return {"dtype": str(array.dtype), "shape": list(array.shape), "sha256": digest}


def _hash_json(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _reason(error: BaseException) -> str:
    """What an error says, in one line; what the operating system said, where tensorstore quotes it."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    quoted = re.search(r"os_error_code='(\d+)'", str(error))
    if quoted:
        return os.strerror(int(quoted[1]))
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]

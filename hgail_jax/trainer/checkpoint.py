"""Checkpoints: the whole state of a run on disk, written beside the training and checked when read.

A checkpoint is a folder, `<rounds done>`: in `state` an array for each leaf of the state, by name, written by orbax,
and `record.json`. Arrays are stored whole, each with a hash, so that a state can be restored onto any number of devices
and damage is noticed. Nothing in them is code.
"""

import errno
import hashlib
import json
import logging
import os
import shutil
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from hgail_jax.devices.sharding import is_first_process, is_key, without_keys
from hgail_jax.io.files import write_json

SCHEMA = 2
"""Version of the content of a checkpoint; one of another schema is refused."""
KEPT = 3
"""Number of the last checkpoints that are kept, besides the best."""

_RECORD, _STATE, _PARTIAL = "record.json", "state", ".partial"

# orbax tells of each write over several lines; its errors are raised as well.
logging.getLogger("absl").addFilter(lambda record: "orbax" not in record.pathname)


class AnotherRunError(ValueError):
    """A folder or checkpoint belongs to another run; the message names the first difference."""


class Checkpoint(NamedTuple):
    """A checkpoint as read."""

    rounds: int
    """Rounds done."""
    state: Any
    """Training state, arrays placed as the template's are."""
    record: dict
    """Record that was saved beside the state."""
    damaged: tuple[str, ...]
    """A line for each later checkpoint that could not be read."""


class Checkpoints:
    """The checkpoints of one run, of which the last `KEPT` and the best are kept.

    Leaving the context waits for the checkpoint that is being written. Of several processes that train together only
    the first writes and reads.

    Args:
      folder: made with the first checkpoint.
      run: identity of the run, as JSON has it; a checkpoint of another run is refused.

    Raises:
      ValueError: the folder's name is that of a file.

    """

    def __init__(self, folder: Path | str, run: dict) -> None:
        if os.path.lexists(folder) and not os.path.isdir(folder):
            raise ValueError(f"{folder} is no folder, so that no checkpoints can be in it")
        self.folder = Path(folder).resolve()
        self.saved: int | None = None
        """Rounds done in the checkpoint saved last or restored."""
        self._run = as_json(run)
        self._scores: dict[str, list[float]] = {}  # by rounds done
        self._writer = ThreadPoolExecutor(1)
        self._writing: Future[None] | None = None

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, *exception: object) -> None:
        try:
            self._finish_writing()
        finally:
            self._writer.shutdown()

    def path(self, rounds: int) -> Path:
        """Returns the folder of the checkpoint after so many rounds."""
        return self.folder / str(rounds)

    def save(self, rounds: int, state: Any, record: dict, score: Sequence[float] | None) -> None:
        """Copies a state and writes it in the background, under a name that it gets once it is whole and was read back.

        Args:
          rounds: rounds done, more than in any checkpoint before.
          state: any pytree of arrays and PRNG keys; it may be donated once this returns.
          record: anything that JSON can hold.
          score: the checkpoint whose score is largest, in the order of tuples, is the best; one that has none never is.

        Raises:
          FloatingPointError: the state is not finite. Nothing is written.
          OSError: the checkpoint before this one cannot be written, or the folder cannot be made. For this one the
            error comes with the next call, or at the end of the context. Nothing is left of it.
          ValueError: the folder holds checkpoints already and none was restored.

        """
        if self.saved is None and self._rounds_on_disk():
            raise ValueError(f"{self.folder} holds checkpoints; restore one before saving more")
        # Copied, as the arrays may be donated to the next step while they are being written.
        arrays = {name: np.array(leaf, copy=True) for name, leaf in _named(without_keys(state))}
        for name, array in arrays.items():
            if np.issubdtype(array.dtype, np.inexact) and not np.isfinite(array).all():
                raise FloatingPointError(f"{name} is not finite")
        scores = self._scores if score is None else self._scores | {str(rounds): [float(value) for value in score]}
        if is_first_process():
            if self._writing is None:
                self._writing = self._writer.submit(self._prepare)
            self._finish_writing()
            self._scores = scores
            body = {"schema": SCHEMA, "run": self._run, "rounds": rounds, "scores": scores, "record": as_json(record)}
            self._writing = self._writer.submit(self._write, rounds, arrays, body)
        self.saved = rounds

    def restore(self, template: Any) -> Checkpoint | None:
        """Reads the latest checkpoint that is whole; None if there is no checkpoint. Writes nothing.

        Args:
          template: a pytree of arrays, or of `jax.ShapeDtypeStruct`, like the state that was saved.

        Raises:
          AnotherRunError: the checkpoint is of another run or schema.
          ValueError: there are checkpoints, and none can be read.

        """
        damaged: list[str] = []
        for rounds in self._rounds_on_disk():
            try:
                body = _read_body(self.path(rounds))
                self._refuse_others(body, template)
                if body["rounds"] != rounds:
                    raise ValueError(f"it was renamed; it is checkpoint {body['rounds']}")
                arrays = _read_arrays(self.path(rounds) / _STATE, body["arrays"])
            except AnotherRunError:
                raise
            except Exception as error:  # orbax, tensorstore and json raise errors of many types
                damaged.append(f"checkpoint {rounds} in {self.folder} is damaged: {_reason(error)}")
                continue
            self._scores, self.saved = body["scores"], rounds
            return Checkpoint(rounds, _from_arrays(arrays, template), body["record"], tuple(damaged))
        if damaged:
            raise ValueError(f"no checkpoint can be read: {'; '.join(damaged)}")
        return None

    def _rounds_on_disk(self) -> list[int]:
        """Returns the rounds done in the checkpoints that have their name, latest first."""
        names = os.listdir(self.folder) if self.folder.is_dir() else []
        found = sorted((int(name) for name in names if name.isdecimal() and name == str(int(name))), reverse=True)
        if any((self.path(rounds) / "record").is_dir() for rounds in found):
            raise AnotherRunError(f"{self.folder} has checkpoints of schema 1; this version reads {SCHEMA}")
        return found

    def _refuse_others(self, body: dict, template: Any) -> None:
        if body["schema"] != SCHEMA:
            raise AnotherRunError(
                f"{self.folder} has checkpoints of schema {body['schema']}; this version reads {SCHEMA}"
            )
        refuse_another_run(self.folder, body["run"], self._run)
        there = {name: [described["dtype"], described["shape"]] for name, described in body["arrays"].items()}
        leaves = _named(jax.eval_shape(without_keys, template))
        refuse_another_run(self.folder, there, {name: [str(leaf.dtype), list(leaf.shape)] for name, leaf in leaves})

    def _finish_writing(self) -> None:
        """Waits for the writer; raises any error of its own as an OSError."""
        try:
            if self._writing is not None:
                self._writing.result()
        except Exception as error:
            raise OSError(f"cannot write a checkpoint to {self.folder}: {_reason(error)}") from error

    def _prepare(self) -> None:
        """Makes the folder, and removes checkpoints that are not whole and those that the run writes anew."""
        self.folder.mkdir(parents=True, exist_ok=True)
        for path in self.folder.iterdir():
            if path.name.endswith(_PARTIAL):
                shutil.rmtree(path)
        for rounds in self._rounds_on_disk():
            if self.saved is not None and rounds > self.saved:  # damaged, or `restore` had taken it
                shutil.rmtree(self.path(rounds))

    def _write(self, rounds: int, arrays: dict[str, np.ndarray], body: dict) -> None:
        body["arrays"] = {name: _describe(array) for name, array in arrays.items()}
        temporary = self.folder / f".{rounds}{_PARTIAL}"
        try:
            temporary.mkdir()
            with _checkpointer() as orbax:
                orbax.save(temporary / _STATE, args=ocp.args.PyTreeSave(arrays))
                index = orbax.metadata(temporary / _STATE).item_metadata
            if {name: tuple(index[name].shape) for name in index} != {name: arrays[name].shape for name in arrays}:
                raise OSError("the checkpoint is not as it was written")
            write_json(temporary / _RECORD, {"body": body, "sha256": _hash_json(body)})
            _read_body(temporary)
            temporary.rename(self.path(rounds))
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        on_disk, scores = self._rounds_on_disk(), body["scores"]
        best = max(on_disk, key=lambda rounds: (scores.get(str(rounds), []), rounds))
        for old in set(on_disk[KEPT:]) - {best}:
            shutil.rmtree(self.path(old))


def _read_body(folder: Path) -> dict:
    record = json.loads((folder / _RECORD).read_text())
    if _hash_json(record["body"]) != record["sha256"]:
        raise ValueError("its record was altered")
    return record["body"]


def _checkpointer() -> ocp.Checkpointer:
    """Returns orbax's checkpointer of trees of arrays, of which each is a folder of its own.

    The one store of OCDBT would be merged from parts, which are looked for by a pattern: a folder called `[lab] run`
    finds none. Processes other than the first know of no checkpoints, so that orbax must not wait for them.
    """
    first = ocp.options.MultiprocessingOptions(primary_host=0, active_processes={0})
    alone = ocp.options.MultiprocessingOptions() if jax.process_count() == 1 else first
    handler = ocp.PyTreeCheckpointHandler(use_ocdbt=False, multiprocessing_options=alone)
    return ocp.Checkpointer(handler, multiprocessing_options=alone)


def _read_arrays(folder: Path, described: dict) -> dict[str, np.ndarray]:
    as_numpy = {name: ocp.RestoreArgs(restore_type=np.ndarray) for name in described}
    with _checkpointer() as orbax:
        arrays = orbax.restore(folder, args=ocp.args.PyTreeRestore(restore_args=as_numpy))
    for name in described:
        if _describe(arrays[name]) != described[name]:
            raise ValueError(f"{name} is not as it was saved")
    return arrays


def _named(tree: Any) -> list[tuple[str, Any]]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in leaves]


def _from_arrays(arrays: dict[str, np.ndarray], template: Any) -> Any:
    def place(leaf: Any, array: np.ndarray) -> jax.Array:
        # Copied: a step donates its states, so that XLA would write into NumPy's memory.
        value = jax.random.wrap_key_data(jnp.asarray(array)) if is_key(leaf) else array
        return jax.device_put(value, getattr(leaf, "sharding", None), may_alias=False)

    leaves, structure = jax.tree.flatten(template)
    values = [place(leaf, arrays[name]) for leaf, (name, _) in zip(leaves, _named(template), strict=True)]
    return jax.tree.unflatten(structure, values)


def _describe(array: np.ndarray) -> dict:
    digest = hashlib.sha256(np.ascontiguousarray(array).data).hexdigest()
    return {"dtype": str(array.dtype), "shape": list(array.shape), "sha256": digest}


def _hash_json(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _reason(error: BaseException) -> str:
    """Returns an error's message in one line; the operating system's, if it is one of its own or quotes one."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    text = str(error).strip()
    quoted = (os.strerror(code) for code in errno.errorcode if os.strerror(code) in text)
    return next(quoted, (text.splitlines() or [type(error).__name__])[0][:200])


def refuse_another_run(folder: Path | str, there: dict, here: dict) -> None:
    """Raises an AnotherRunError that names the first entry in which two nested dicts, of JSON's types, differ."""
    difference = _difference(there, as_json(here))
    if difference is not None:
        name, *values = difference
        of_there, of_here = ("given" if isinstance(value, dict) else value for value in values)
        raise AnotherRunError(f"{folder} holds another run: {name} is {of_there} there and {of_here} here")


def _difference(there: Any, here: Any, name: str = "") -> tuple[str, Any, Any] | None:
    if not (isinstance(there, dict) and isinstance(here, dict)):
        return None if there == here else (name, there, here)
    for key in [*here, *(key for key in there if key not in here)]:
        found = _difference(there.get(key, "absent"), here.get(key, "absent"), f"{name}.{key}" if name else key)
        if found is not None:
            return found
    return None


def as_json(content: Any) -> Any:
    """Returns `content` as JSON gives it back: tuples are lists, keys are text."""
    return json.loads(json.dumps(content))

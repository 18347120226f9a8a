"""Checkpoints: the whole state of a run (`TrainState`, its buffer and keys) on disk, beside the training.

A checkpoint is a folder, `<rounds done>/state`, with `arrays.npz`, the leaves of the state, whole, and `record.json`,
with a hash. Beside the checkpoints `history.jsonl` has a line for each round; it only grows, so that a checkpoint costs
the same after any number of rounds. Nothing in them is code. Orbax writes in the background, renames what is whole and
removes what is old.
"""

import contextlib
import dataclasses
import hashlib
import json
import logging
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from hgail_jax.devices.sharding import is_first_process, is_key, without_keys

SCHEMA = 4
"""Version of the content of a checkpoint; one of another schema is refused."""
LOOK_SIZES = "look_sizes"
"""Entry of an identity that runs of older versions do not have, and may lack."""
KEPT = 3
"""Number of the last checkpoints that are kept, besides the best."""

_STATE, _RECORD, _ARRAYS, _HISTORY = "state", "record.json", "arrays.npz", "history.jsonl"
_TEMPORARY = ".orbax-checkpoint-tmp"  # in the name of a checkpoint that is not whole

# Orbax logs each write over several lines; its errors are raised as well.
logging.getLogger("absl").addFilter(lambda record: "orbax" not in record.pathname)


class Checkpoint(NamedTuple):
    """A checkpoint as read."""

    rounds: int
    """Rounds done."""
    state: Any
    """Training state, arrays placed as the template's are."""
    record: dict
    """Record that was saved beside the state."""
    history: list[dict]
    """Rows that were saved with it and before it."""
    damaged: tuple[str, ...]
    """A line for each later checkpoint that could not be read."""


class Checkpoints:
    """The checkpoints of one run, of which the last `KEPT` and the best are kept.

    The folder is made with the first of them. A checkpoint of another run, by its identity, is refused. Leaving the
    context waits for the checkpoint that is being written. Of several processes that train together only the first
    writes and reads.

    Raises:
      AnotherRunError: the folder has checkpoints of another schema.
      ValueError: the folder's name is that of a file.
    """

    def __init__(self, folder: Path | str, run: dict) -> None:
        if os.path.lexists(folder) and not os.path.isdir(folder):
            raise ValueError(f"{folder} is no folder, so that no checkpoints can be in it")
        self.folder = Path(folder).resolve()
        self.saved: int | None = None
        """Rounds done in the checkpoint saved last or restored."""
        self._run = as_json(run)
        self._scores: dict[str, list[float]] = {}  # by rounds done, of the checkpoints that are there
        self._history = _History(self.folder / _HISTORY)
        self._manager: ocp.CheckpointManager | None = None
        for path in map(self.path, self._rounds_on_disk()):
            if (path / "record.json").exists() or (path / "record").is_dir():
                raise AnotherRunError(f"{folder} has checkpoints of hgail-jax 0.3 or earlier, which 0.4 cannot read")

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, *exception: object) -> None:
        if self._manager is not None:
            with self._writing():
                self._manager.close()

    def path(self, rounds: int) -> Path:
        """Returns the folder of the checkpoint after so many rounds."""
        return self.folder / str(rounds)

    def save(
        self, rounds: int, state: Any, record: dict, score: Sequence[float] | None, history: Sequence[dict] = ()
    ) -> None:
        """Copies a state and writes it in the background, under a name that it gets once it is whole.

        The state, any pytree of arrays and PRNG keys, may be donated once this returns. The checkpoint whose `score` is
        largest, in the order of tuples, is the best; one that has none never is. More `rounds` are done than in any
        checkpoint before, and JSON can hold the record. The `history` begins with the rows saved or restored before;
        only those after them are written.

        Raises:
          FloatingPointError: the state is not finite. Nothing is written.
          OSError: the checkpoint before this one cannot be written, or the folder cannot be made. For this one the
            error comes with the next call, or at the end of the context. Nothing is left of it.
          ValueError: the folder holds checkpoints already and none was restored.
        """
        if self.saved is None and self._rounds_on_disk():
            raise ValueError(f"{self.folder} holds checkpoints; restore one before saving more")
        # Copied, as the arrays may be donated to the next step while they are being written.
        arrays = {name: np.array(leaf, copy=True) for name, leaf in _arrays(state).items()}
        for name, array in arrays.items():
            if np.issubdtype(array.dtype, np.inexact) and not np.isfinite(array).all():
                raise FloatingPointError(f"{name} is not finite")
        if is_first_process():
            with self._writing():
                self._manager = self._manager or self._open()
                self._manager.wait_until_finished()
                self._history.append(history[self._history.rows :])
                self._note(rounds, score)
                body = {"schema": SCHEMA, "rounds": rounds, "run": self._run, "record": record}
                body |= {"history": self._history.extent(), "scores": self._scores, "names": list(arrays)}
                content = _Content(arrays, as_json(body))
                self._manager.save(rounds, args=ocp.args.Composite(**{_STATE: content}))
        self.saved = rounds

    def restore(self, template: Any) -> Checkpoint | None:
        """Reads the latest checkpoint that is whole; None if there is no checkpoint. Writes nothing.

        The template is a pytree of arrays, or of `jax.ShapeDtypeStruct`, like the state that was saved.

        Raises:
          AnotherRunError: the checkpoint is of another run or schema.
          ValueError: there are checkpoints, and none can be read.
        """
        damaged: list[str] = []
        for rounds in self._rounds_on_disk():
            try:
                content = _Handler().restore(self.path(rounds) / _STATE)
                self._refuse_another_schema(content.body["schema"])
                history = self._history.read(content.body["history"])
            except AnotherRunError:
                raise
            except Exception as error:  # zipfile, numpy and json raise errors of many types
                damaged.append(f"checkpoint {rounds} in {self.folder} is damaged: {_reason(error)}")
                continue
            state = self._state(content, template)
            self._scores, self.saved = content.body["scores"], rounds
            return Checkpoint(rounds, state, content.body["record"], history, tuple(damaged))
        if damaged:
            raise ValueError(f"no checkpoint can be read: {'; '.join(damaged)}")
        return None

    def _rounds_on_disk(self) -> list[int]:
        """Returns the rounds done in the checkpoints that have their name, latest first."""
        names = os.listdir(self.folder) if self.folder.is_dir() else []
        return sorted((int(name) for name in names if name.isdecimal() and name == str(int(name))), reverse=True)

    def _note(self, rounds: int, score: Sequence[float] | None) -> None:
        """Adds a score to those of the checkpoints that are there."""
        there = {str(rounds) for rounds in self._rounds_on_disk()}
        for name in self._scores.keys() - there:
            del self._scores[name]
        if score is not None:
            self._scores[str(rounds)] = [float(value) for value in score]

    def _refuse_another_schema(self, schema: int) -> None:
        if schema != SCHEMA:
            raise AnotherRunError(f"{self.folder} has checkpoints of schema {schema}; this version reads {SCHEMA}")

    def _state(self, content: "_Content", template: Any) -> Any:
        """Returns the state, placed as the template's is, unless it is that of another run."""
        refuse_another_run(self.folder, content.body["run"], self._run)
        refuse_another_run(self.folder, _describe(content.arrays), _describe(jax.eval_shape(_arrays, template)))

        def place(leaf: Any, array: np.ndarray) -> jax.Array:
            # Copied: a step donates its states, so that XLA would write into NumPy's memory.
            value = jax.random.wrap_key_data(jnp.asarray(array)) if is_key(leaf) else array
            return jax.device_put(value, getattr(leaf, "sharding", None), may_alias=False)

        leaves, structure = jax.tree.flatten(template)
        return jax.tree.unflatten(structure, map(place, leaves, content.arrays.values()))

    def _open(self) -> ocp.CheckpointManager:
        """Makes the folder, and removes checkpoints that are not whole and those that the run writes anew."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self._remove_unfinished()
        for rounds in self._rounds_on_disk():
            if self.saved is not None and rounds > self.saved:  # damaged, or `restore` had taken it
                shutil.rmtree(self.path(rounds))
        # Processes other than the first know of no checkpoints, so that orbax must not wait for them.
        alone = jax.process_count() == 1
        first = ocp.options.MultiprocessingOptions(primary_host=0, active_processes=None if alone else {0})
        options = ocp.CheckpointManagerOptions(
            preservation_policy=_LastAndBest(self._scores),
            multiprocessing_options=first,
            create=False,
            save_root_metadata=False,
            lightweight_initialize=True,
        )
        registry = ocp.DefaultCheckpointHandlerRegistry()
        registry.add(_STATE, _Content, _Handler())
        return ocp.CheckpointManager(self.folder, options=options, handler_registry=registry)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Raises any error of the writer's as an OSError, once nothing is left of the checkpoint."""
        try:
            yield
        except Exception as error:  # orbax raises errors of many types
            self._remove_unfinished()
            raise OSError(f"cannot write a checkpoint to {self.folder}: {_reason(error)}") from error

    def _remove_unfinished(self) -> None:
        for path in self.folder.iterdir() if self.folder.is_dir() else ():
            if _TEMPORARY in path.name:
                shutil.rmtree(path, ignore_errors=True)


class _History:
    """A file of rows, a line of JSON each, that only grows: a checkpoint says how far it had got."""

    def __init__(self, path: Path) -> None:
        self.rows = 0
        """Number of rows read or written."""
        self._path, self._bytes, self._hash = path, 0, hashlib.sha256()

    def append(self, rows: Sequence[dict]) -> None:
        """Writes rows behind those read or written, where a killed process may have left others."""
        if not rows:
            return
        text = "".join(json.dumps(row) + "\n" for row in rows).encode()
        self._path.touch()
        os.truncate(self._path, self._bytes)
        with self._path.open("ab") as file:
            file.write(text)
        self._hash.update(text)
        self._bytes, self.rows = self._bytes + len(text), self.rows + len(rows)

    def extent(self) -> dict:
        """Returns the length and the hash of the file."""
        return {"bytes": self._bytes, "sha256": self._hash.hexdigest()}

    def read(self, extent: dict) -> list[dict]:
        """Returns the rows of a former extent, behind which `append` then writes."""
        text = self._path.read_bytes()[: extent["bytes"]] if extent["bytes"] else b""
        if hashlib.sha256(text).hexdigest() != extent["sha256"]:
            raise ValueError(f"{self._path.name} was altered")
        rows = [json.loads(line) for line in text.splitlines()]
        self.rows, self._bytes, self._hash = len(rows), len(text), hashlib.sha256(text)
        return rows


@dataclasses.dataclass
class _Content(ocp.args.CheckpointArgs):
    """Content of a checkpoint, as orbax hands it to the handler."""

    arrays: dict[str, np.ndarray]
    body: dict


class _Handler(ocp.AsyncCheckpointHandler):
    """Writes a checkpoint's two files; orbax's own prints a traceback for each array on a full disk."""

    async def async_save(self, directory: Path, args: _Content) -> list[ocp.future.Future]:
        async def write() -> None:
            self.save(directory, args)

        return [ocp.future.CommitFutureAwaitingContractedSignals(write())]

    def save(self, directory: Path, args: _Content) -> None:
        np.savez(Path(directory) / _ARRAYS, *args.arrays.values())
        body = args.body | {"sha256": _digest(directory, args.body)}
        (Path(directory) / _RECORD).write_text(json.dumps(body))

    def restore(self, directory: Path, args: object = None) -> _Content:
        body = json.loads((Path(directory) / _RECORD).read_text())
        if body.pop("sha256") != _digest(directory, body):
            raise ValueError("it was altered")
        with np.load(Path(directory) / _ARRAYS, allow_pickle=False) as file:
            return _Content(dict(zip(body["names"], file.values(), strict=True)), body)


def _digest(directory: Path, body: dict) -> str:
    with open(Path(directory) / _ARRAYS, "rb") as file:
        digest = hashlib.file_digest(file, "sha256")
    digest.update(json.dumps(body, sort_keys=True).encode())
    return digest.hexdigest()


class _LastAndBest(ocp.checkpoint_managers.PreservationPolicy):
    """Keeps the last `KEPT` checkpoints and that of the largest score, the latest of equals."""

    def __init__(self, scores: dict[str, list[float]]) -> None:
        self._scores = scores

    def should_preserve(self, checkpoints: Sequence[Any], *, context: Any) -> list[bool]:
        steps = [checkpoint.step for checkpoint in checkpoints]
        best = max(steps, key=lambda step: (self._scores.get(str(step), []), step))
        return [step == best or step in steps[-KEPT:] for step in steps]


def _arrays(tree: Any) -> dict[str, Any]:
    """Returns the leaves of a state by name, keys as numbers."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(without_keys(tree))
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def _describe(arrays: dict[str, Any]) -> dict:
    return {name: [str(array.dtype), list(array.shape)] for name, array in arrays.items()}


def _reason(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return next(iter(str(error).splitlines()), type(error).__name__)[:200]


class AnotherRunError(ValueError):
    """A folder or checkpoint belongs to another run; the message names the first difference."""


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
    for key in sorted(here | there, key=lambda key: key in here and key in there):  # what one lacks decides the rest
        # An older version's run has no sizes of its look, or not the one of a kind of variation that came later.
        if key not in there and (key == LOOK_SIZES or (LOOK_SIZES in name and not here[key])):
            continue
        found = _difference(there.get(key, "absent"), here.get(key, "absent"), f"{name}.{key}" if name else key)
        if found is not None:
            return found
    return None


def as_json(content: Any) -> Any:
    """Returns `content` as JSON gives it back: tuples are lists, keys are text."""
    return json.loads(json.dumps(content, default=lambda number: number.tolist()))  # NumPy's

"""Loggers of a run's measurements: a table, TensorBoard, Weights & Biases; each is a class in `LOGGERS`."""

import importlib
import itertools
import json
import os
import uuid
from pathlib import Path
from typing import Any, ClassVar

import imageio
import numpy as np
from flax.traverse_util import flatten_dict

from hgail_envs.validation import check_name
from hgail_jax.io.files import append_csv, replace_file, write_csv
from hgail_jax.trainer.run import Run
from hgail_jax.trainer.statistics import confidence_interval

_PROJECT = "hgail_jax"
_FILM_STEP = 4  # TensorBoard is given every fourth frame of a film, and every fourth row and column of it

Record = dict[str, Any]
"""Measurements of a round, see `hgail_jax.trainer.loop.round_record`."""


class Logger:
    """Writes a run's measurements to one place.

    It is given the settings as config.json has them, and the records of the rounds done before a resumed checkpoint. An
    OSError says that it cannot be opened.
    """

    library: ClassVar[str | None] = None
    """Module that it needs; the extra which installs it has the logger's name."""

    def __init__(self, folder: Path, run: Run, settings: dict[str, Any], history: list[Record]) -> None:
        del settings, history
        self.folder, self.run, self._done = folder, run, 0

    @classmethod
    def check(cls) -> None:
        """Raises a ValueError if it cannot be used here although its library is installed."""

    def rounds(self, history: list[Record]) -> None:
        """Writes the records of all rounds so far, those that are new by `log`; called after each round."""
        for record in history[self._done :]:
            self.log(record)
        self._done = len(history)

    def log(self, record: Record) -> None:
        """Writes the record of a round."""

    def finish(self, summary: dict[str, Any], curves: Path) -> None:
        """Writes the results: summary.json's content and the picture of the learning curves."""

    def film(self, path: Path) -> None:
        """Adds a film of the trained policy."""

    def close(self) -> None:
        """Ends the log, for this process."""


class CsvLogger(Logger):
    """metrics.csv, a row per round and seed; a cell is empty if the round did not measure it."""

    def rounds(self, history: list[Record]) -> None:
        rows = [
            {"seed": self.run.first_seed + seed}
            | {name: values[seed] if isinstance(values, list) else values for name, values in record.items()}
            for record in history[self._done :]
            for seed in range(self.run.seeds)
        ]
        # at first the whole table, as a resumed run repeats the rounds after its checkpoint
        (append_csv if self._done else write_csv)(self.folder / "metrics.csv", rows)
        self._done = len(history)


class TensorboardLogger(Logger):
    """TensorBoard's event files in `tensorboard/`, over environment steps per seed."""

    library = "tensorboardX"

    def __init__(self, folder: Path, run: Run, settings: dict[str, Any], history: list[Record]) -> None:
        from tensorboardX import SummaryWriter

        super().__init__(folder, run, settings, history)
        resumes = (folder / "tensorboard").is_dir()
        self._done = len(history) if resumes else 0
        # Rounds after the checkpoint that a run resumes from are run, and logged, again.
        purge = (history[-1]["env_steps"] + 1 if history else 0) if resumes else None
        # A file is named by its second and its host: one of the same second would be overwritten.
        number = len(list((folder / "tensorboard").glob("events*")))
        self._writer = SummaryWriter(str(folder / "tensorboard"), purge_step=purge, filename_suffix=f".{number:03d}")
        if not resumes:
            self._writer.add_text("settings", f"```json\n{json.dumps(settings, indent=2, default=str)}\n```")

    def log(self, record: Record) -> None:
        for name, value in scalars(record, self.run.first_seed).items():
            self._writer.add_scalar(name, value, record["env_steps"])
        self._writer.flush()

    def finish(self, summary: dict[str, Any], curves: Path) -> None:
        self._writer.add_image("curves", imageio.v3.imread(curves), dataformats="HWC")
        settings = flatten_dict(self.run.identity(), sep=".")
        plain = {
            name: value if isinstance(value, bool | int | float) else str(value)
            for name, value in settings.items()
            if value is not None
        }
        self._writer.add_hparams(plain, _final(summary), name="summary")

    def film(self, path: Path) -> None:
        # TensorBoard shows a film as a GIF; this one is small and coarse
        from tensorboardX.proto.summary_pb2 import Summary

        reader: Any  # which iterates, and is not typed so
        with imageio.get_reader(path) as reader:
            rate = reader.get_meta_data()["fps"] / _FILM_STEP
            frames = itertools.islice(reader, 0, None, _FILM_STEP)
            pictures = [np.asarray(frame)[::_FILM_STEP, ::_FILM_STEP] for frame in frames]
        gif = imageio.v3.imwrite("<bytes>", np.stack(pictures), extension=".gif", duration=1000 / rate, loop=0)
        height, width, _ = pictures[0].shape
        image = Summary.Image(encoded_image_string=gif, height=height, width=width, colorspace=3)
        self._writer.file_writer.add_summary(Summary(value=[Summary.Value(tag="film", image=image)]))

    def close(self) -> None:
        self._writer.close()


class WandbLogger(Logger):
    """A run of Weights & Biases, kept in `wandb/` where `WANDB_MODE` is offline."""

    library = "wandb"

    def __init__(self, folder: Path, run: Run, settings: dict[str, Any], history: list[Record]) -> None:
        import wandb

        super().__init__(folder, run, settings, history)
        name = folder / "wandb" / "run-id"
        resumes = name.exists()
        self._done = len(history) if resumes else 0
        if not resumes:
            name.parent.mkdir(exist_ok=True)
            with replace_file(name) as file:
                file.write(uuid.uuid4().hex[:8])
        try:
            self._run = wandb.init(
                project=os.environ.get("WANDB_PROJECT", _PROJECT),
                name=folder.name,
                id=name.read_text(),
                resume="allow",
                dir=folder.resolve(),
                config=json.loads(json.dumps(settings, default=str)),
                settings=wandb.Settings(console="off", silent=True),
            )
        except Exception as error:  # wandb raises errors of many types
            raise OSError(f"wandb cannot begin: {error}") from error
        self._run.define_metric("env_steps")
        self._run.define_metric("*", step_metric="env_steps")

    @classmethod
    def check(cls) -> None:
        import wandb

        if wandb.setup().settings.mode == "online" and not wandb.login(prompt=False):
            raise ValueError("the logger wandb has no account here; call wandb login, or set WANDB_MODE=offline")

    def log(self, record: Record) -> None:
        self._run.log(scalars(record, self.run.first_seed))

    def finish(self, summary: dict[str, Any], curves: Path) -> None:
        import wandb

        self._run.summary.update(_final(summary))
        self._run.log({"curves": wandb.Image(str(curves))})

    def film(self, path: Path) -> None:
        import wandb

        self._run.log({"film": wandb.Video(str(path), format="mp4")})

    def close(self) -> None:
        self._run.finish()


LOGGERS: dict[str, type[Logger]] = {"csv": CsvLogger, "tensorboard": TensorboardLogger, "wandb": WandbLogger}
"""Loggers by name."""


def check_loggers(names: str) -> tuple[str, ...]:
    """Returns the loggers in a list of names with commas between them, if they can be used here."""
    chosen = tuple(dict.fromkeys(names.split(",")))
    for name in chosen:
        check_name("logger", name, LOGGERS)
        library = LOGGERS[name].library
        try:
            if library is not None:
                importlib.import_module(library)
        except ImportError as error:
            raise ValueError(f"the logger {name} needs {library}: pip install 'hgail-jax[{name}]' ({error})") from None
        LOGGERS[name].check()
    return chosen


def scalars(record: Record, first_seed: int) -> dict[str, float]:
    """Returns the measurements of a round by name, as dashboards group them.

    A value of each seed becomes `name/seed-0` and so on, with `name/mean` and, from three seeds on,
    `name/interval_low` and `name/interval_high`: the 95 % interval of the mean by Student's t.
    """
    found: dict[str, float] = {}
    for name, values in record.items():
        if not isinstance(values, list):
            found[name] = values
            continue
        known = np.array([value for value in values if value is not None])
        found |= {f"{name}/seed-{first_seed + seed}": value for seed, value in enumerate(values) if value is not None}
        if known.size:
            found[f"{name}/mean"] = float(known.mean())
        half = float(confidence_interval(known)) if known.size else np.nan
        if np.isfinite(half):
            found |= {f"{name}/interval_low": found[f"{name}/mean"] - half}
            found |= {f"{name}/interval_high": found[f"{name}/mean"] + half}
    return found


def _final(summary: dict[str, Any]) -> dict[str, float]:
    measured = {name: value["mean"] for name, value in summary.items() if isinstance(value, dict) and "mean" in value}
    return {f"final/{name}": float(value) for name, value in measured.items() if np.isfinite(value)}

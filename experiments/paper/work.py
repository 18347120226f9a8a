"""What a call for tables and figures comes to: which studies are missing, and the training of them."""

import dataclasses
import functools
import json
import shutil
import threading
from pathlib import Path
from typing import Any

from experiments.paper.figures import draw_figure
from experiments.paper.programs import group_by_program, time_sweep, train_program
from experiments.paper.studies import FIGURES, MOST_DEMONSTRATIONS, SWEEP, Setting, Study
from experiments.paper.tables import files, write_study
from experiments.paper.trials import Scale, Trial, hash_json, work_out
from hgail_jax.io.demonstrations import Demonstrations
from hgail_jax.io.files import write_json
from hgail_jax.recording import load_or_record, make_for_demonstrations
from hgail_jax.trainer.identity import refuse_another_run
from hgail_jax.trainer.provenance import provenance


@dataclasses.dataclass(frozen=True)
class Work:
    """What the options ask for, worked out."""

    scale: Scale
    seeds: int
    folder: Path
    studies: tuple[Study, ...]
    sweep: bool = False
    """Whether to time many settings as one program."""

    @property
    def task(self) -> str:
        """The task's name."""
        return self.scale.task

    @functools.cached_property
    def demonstrations(self) -> Demonstrations:
        """All demonstrations of the task; recorded where the folder has none."""
        path = self.folder / "demonstrations" / f"{self.task}.npz"
        env = make_for_demonstrations(self.task, MOST_DEMONSTRATIONS)
        return load_or_record(path, env, self.task, MOST_DEMONSTRATIONS)

    def trial(self, setting: Setting) -> Trial:
        """Returns a setting worked out for the task."""
        count = setting.demonstrations
        identity = self.demonstrations.first(count).sha256 if count else None
        return work_out(self.scale, setting, self.seeds, identity)


def unfinished(work: Work) -> list[tuple[Study, list[Trial]]]:
    """Returns the studies whose data are not in the folder yet, with their trials; a figure alone is drawn again.

    Raises:
      ValueError: the folder holds one of them with other settings.

    """
    found = []
    for study in work.studies:
        trials = [work.trial(setting) for setting in study.settings]
        path = _json_path(work, study)
        if path.exists():
            there = _read_json(path)
            refuse_another_run(path, there.get("settings", {}), _identities(trials))
            missing = {name for name, file in files(work.folder, work.task, study).items() if not file.exists()}
            if not missing - {"figure"}:
                if missing and study.figure is not None:
                    draw_figure(work.folder, study.figure)
                print(f"{study.name} of {work.task} is there")
                continue
        found.append((study, trials))
    return found


def carry_out(work: Work, studies: list[tuple[Study, list[Trial]]], stop: threading.Event) -> None:
    """Trains what is missing, one program after another, and writes each study once all of its trials are there.

    Ends early, with a checkpoint, once `stop` is set.
    """
    trials = {trial.key(): trial for _, of_study in studies for trial in of_study}
    groups = group_by_program(trial for key, trial in trials.items() if not _part_path(work, key).exists())
    _write_complete(work, studies)
    for index, group in enumerate(groups):
        if stop.is_set():
            return
        names = "; ".join(_label(trial.setting) for trial in group)
        print(f"program {index + 1} of {len(groups)}: {names}", flush=True)
        env = work.scale.make_env(len(group) * work.seeds * group[0].config.num_envs)
        count = group[0].setting.demonstrations
        samples = work.demonstrations.first(count).samples(env) if count else None
        checkpoints = work.folder / "parts" / hash_json([trial.key() for trial in group])
        results = train_program(env, group, samples, checkpoints, stop)
        if results is None:
            return
        for trial, result in zip(group, results, strict=True):
            write_json(_part_path(work, trial.key()), result | {"identity": trial.identity(), "made_by": provenance()})
        shutil.rmtree(checkpoints, ignore_errors=True)
        _write_complete(work, studies)


def _write_complete(work: Work, studies: list[tuple[Study, list[Trial]]]) -> None:
    """Writes, and takes off the list, the studies whose trials are all there."""
    for study, trials in list(studies):
        parts = [_part_path(work, trial.key()) for trial in trials]
        if not all(path.exists() for path in parts):
            continue
        results = [_read_json(path) for path in parts]
        write_study(work.folder, work.task, study, results)
        made = {
            _label(trial.setting): {name: result[name] for name in ("final", "program", "made_by")}
            for trial, result in zip(trials, results, strict=True)
        }
        identities = _identities(trials)
        content = {"hash": hash_json(identities), "settings": identities, "made": made}
        write_json(_json_path(work, study), content)
        studies.remove((study, trials))
        print(f"{study.name} of {work.task} -> {_json_path(work, study).parent}")


def time_one_program(work: Work) -> None:
    """Writes sweep-<task>.json."""
    path = work.folder / f"sweep-{work.task}.json"
    if path.exists():
        print(f"{path} is there")
        return
    trials = [work.trial(setting) for setting in SWEEP]
    env = work.scale.make_env(len(trials) * work.seeds * trials[0].config.num_envs)
    timed = time_sweep(env, trials)
    write_json(path, timed | {"config": dataclasses.asdict(trials[0].config)} | provenance())
    print(f"one program is {timed['ratio']:.1f} times as fast as {len(trials)} one after another -> {path}")


def redraw(folder: Path) -> None:
    """Draws every figure whose data a folder holds.

    Raises:
      ValueError: it holds none, or data that cannot be read.

    """
    drawn = [draw_figure(folder, number) for number in sorted(FIGURES)]
    if not any(drawn):
        raise ValueError(f"{folder} holds no figure's data")
    print(", ".join(str(path) for path in drawn if path))


def _identities(trials: list[Trial]) -> dict[str, Any]:
    return {_label(trial.setting): trial.identity() for trial in trials}


def _label(setting: Setting) -> str:
    return ", ".join(filter(None, (setting.name, setting.panel)))


def _json_path(work: Work, study: Study) -> Path:
    return work.folder / f"{study.name}-{work.task}.json"


def _part_path(work: Work, key: str) -> Path:
    """Returns where a trial's result is kept until all that need it are written, and for those that come later."""
    return work.folder / "parts" / f"{key}.json"


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is damaged, remove it: {error}") from None

"""Work of a command: the studies that are missing, and the programs that train them."""

import dataclasses
import datetime
import shutil
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.paper.figures import draw_figure, figure_path
from experiments.paper.markdown import label
from experiments.paper.programs import group_by_program, time_sweep, train_program
from experiments.paper.studies import STUDIES, SWEEP
from experiments.paper.study import MOST_DEMONSTRATIONS, Setting, Study, choose_seeds
from experiments.paper.tables import json_path, read_study, set_aside, write_markdown, write_study
from experiments.paper.trials import Scale, Trial, hash_json, work_out
from hgail_jax.io.demonstrations import Demonstrations, load_demonstrations, save_demonstrations
from hgail_jax.io.files import write_json
from hgail_jax.io.provenance import provenance
from hgail_jax.learners import PPO
from hgail_jax.play.recording import make_for_demonstrations, record
from hgail_jax.trainer.checkpoint import AnotherRunError, refuse_another_run


@dataclasses.dataclass(frozen=True)
class Work:
    """Studies of a task that a command asks for."""

    scale: Scale
    seeds: int | None
    """Number of seeds; None is a study's own."""
    folder: Path
    studies: tuple[Study, ...]
    sweep: bool = False
    """True to time many settings as one program."""

    @property
    def task(self) -> str:
        """The task's name."""
        return self.scale.task

    def demonstrations(self, learner: str) -> Demonstrations:
        """Returns all demonstrations of the task as a learner observes it, recorded if the folder has none."""
        name = self.task if learner == PPO.name else f"{self.task}-{learner}"
        path = self.folder / "demonstrations" / f"{name}.npz"
        if not path.exists():
            env = make_for_demonstrations(self.task, MOST_DEMONSTRATIONS, learner=learner)
            path.parent.mkdir(parents=True, exist_ok=True)
            save_demonstrations(path, record(env, self.task, MOST_DEMONSTRATIONS))
        return load_demonstrations(path, self.task).first(MOST_DEMONSTRATIONS)

    def trial(self, setting: Setting) -> Trial:
        """Resolves a setting for the task."""
        count = setting.demonstrations
        identity = self.demonstrations(setting.learner).first(count).sha256 if count else None
        return work_out(self.scale, setting, choose_seeds(self.seeds), identity)

    def made_by(self) -> dict[str, Any]:
        """Returns the provenance of a result made now."""
        date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        return provenance() | {"date": date}


@dataclasses.dataclass(frozen=True)
class Job:
    """Trials that one program trains."""

    work: Work
    trials: list[Trial]

    @property
    def names(self) -> str:
        """Names of its trials."""
        return f"{self.work.task}: {'; '.join(trial.setting.label for trial in self.trials)}"

    def carry_out(self, stop: threading.Event) -> None:
        """Trains and evaluates, and saves the result of each trial.

        It ends early, with a checkpoint, once `stop` is set.
        """
        work, first = self.work, self.trials[0]
        worlds = len(self.trials) * len(first.seeds) * first.config.num_envs
        env = work.scale.make_env(worlds, **first.task_options)
        count, learner = first.setting.demonstrations, first.setting.learner
        samples = work.demonstrations(learner).first(count).samples(env) if count else None
        checkpoints = work.folder / "parts" / hash_json([trial.key() for trial in self.trials])
        results = train_program(env, self.trials, samples, checkpoints, stop)
        if results is None:
            return
        for trial, result in zip(self.trials, results, strict=True):
            made = {"identity": trial.identity(), "made_by": work.made_by()}
            write_json(_part_path(work, trial), result | made)
        shutil.rmtree(checkpoints, ignore_errors=True)


class Unfinished:
    """Studies of a task whose data are not in the folder yet.

    Raises:
      ValueError: a file of the folder is damaged.
    """

    def __init__(self, work: Work) -> None:
        self.work = work
        self._studies = [(study, trials) for study, trials in _resolved(work) if not _is_there(work, study, trials)]

    def jobs(self) -> list[Job]:
        """Returns the programs that remain to be trained."""
        trials = {trial.key(): trial for _, of_study in self._studies for trial in of_study}
        missing = [trial for trial in trials.values() if not _part_path(self.work, trial).exists()]
        return [Job(self.work, group) for group in group_by_program(missing)]

    def write_complete(self) -> None:
        """Writes the studies whose trials are all there; older results of other settings are set aside."""
        for study, trials in list(self._studies):
            parts = [_part_path(self.work, trial) for trial in trials]
            if all(path.exists() for path in parts):
                _write(self.work, study, trials, [read_study(path) for path in parts])
                self._studies.remove((study, trials))


def carry_out(unfinished: Sequence[Unfinished], stop: threading.Event) -> None:
    """Trains the missing trials, a program after the other, and writes each study once all of its trials are there.

    It ends early, with a checkpoint, once `stop` is set.

    Raises:
      OSError: a file cannot be written.
      OverflowError, FloatingPointError: see `train_program`.
    """

    def write() -> None:
        for of_task in unfinished:
            of_task.write_complete()

    write()
    jobs = [job for of_task in unfinished for job in of_task.jobs()]
    for index, job in enumerate(jobs):
        if stop.is_set():
            return
        print(f"program {index + 1} of {len(jobs)}: {job.names}", flush=True)
        job.carry_out(stop)
        write()


def _resolved(work: Work) -> list[tuple[Study, list[Trial]]]:
    return [(study, [work.trial(setting) for setting in study.settings]) for study in work.studies]


def _is_there(work: Work, study: Study, trials: list[Trial]) -> bool:
    """Returns whether a study's results are in the folder; a missing table or figure is made from them."""
    path = json_path(work.folder, work.task, study)
    if not path.exists():
        return False
    rows = read_study(path)["settings"]
    try:
        refuse_another_run(path, _identities_there(rows), _identities(trials))
    except AnotherRunError as error:
        print(f"{study.name} of {work.task} is made again, and what is there goes to older/: {error}")
        return False
    if not (table := path.with_suffix(".md")).exists():
        write_markdown(table, work.task, study, rows)
    if study.figure is not None and not figure_path(work.folder, study.figure).exists():
        draw_figure(work.folder, study.figure)
    commits = sorted({str(row["made_by"]["commit"]) for row in rows})
    print(f"{study.name} of {work.task} is there, of commit {', '.join(commits)}")
    return True


def _write(work: Work, study: Study, trials: list[Trial], results: list[dict[str, Any]]) -> None:
    """Writes a study; results of other settings move to older/<their hash>/."""
    path = json_path(work.folder, work.task, study)
    if path.exists() and (there := _identities_there(read_study(path)["settings"])) != _identities(trials):
        set_aside(work.folder / "older" / hash_json(there), path)
    write_study(work.folder, work.task, study, results)
    print(f"{study.name} of {work.task} -> {path.parent}")


def time_one_program(work: Work) -> None:
    """Writes sweep-<task>.json."""
    path = work.folder / f"sweep-{work.task}.json"
    if path.exists():
        print(f"{path} is there")
        return
    trials = [work.trial(setting) for setting in SWEEP]
    env = work.scale.make_env(len(trials) * len(trials[0].seeds) * trials[0].config.num_envs)
    timed = time_sweep(env, trials)
    write_json(path, timed | {"config": trials[0].config.as_dict()} | work.made_by())
    print(f"one program is {timed['ratio']:.1f} times as fast as {len(trials)} one after another -> {path}")


def redraw(folder: Path) -> None:
    """Draws every figure whose data a folder holds.

    Raises:
      ValueError: the folder holds no data, or unreadable data.
    """
    drawn = [draw_figure(folder, number) for number in sorted({study.figure for study in STUDIES if study.figure})]
    if not any(drawn):
        raise ValueError(f"{folder} holds no figure's data")
    print(", ".join(str(path) for path in drawn if path))


def _identities(trials: Sequence[Trial]) -> dict[str, Any]:
    return {trial.setting.label: trial.identity() for trial in trials}


def _identities_there(rows: list[dict[str, Any]]) -> dict[str, Any]:
    return {label(row): row["identity"] for row in rows}


def _part_path(work: Work, trial: Trial) -> Path:
    """Returns the file of a trial's result, kept for all studies that have the trial."""
    return work.folder / "parts" / f"{trial.key()}.json"

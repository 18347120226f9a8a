"""Makes the paper's tables and figures: trains what they compare, and writes data, tables and pictures."""

import contextlib
import dataclasses
import functools
import json
import os
import shutil
import sys
import threading
from pathlib import Path
from typing import Literal

from experiments.paper.programs import programs, time_sweep, train_program
from experiments.paper.reporting import draw_figure, files, write_study
from experiments.paper.sizes import Sizes, make_env, platform_name, sizes
from experiments.paper.studies import (
    FIGURES,
    LONGER,
    MOST_DEMONSTRATIONS,
    STUDIES,
    SWEEP,
    Setting,
    Study,
    Trial,
    hash_json,
    work_out,
)
from hgail_jax.cli.command_line import cache_compilations, fail, parse
from hgail_jax.distributed.seeds import check_seeds
from hgail_jax.io.demonstrations import Demonstrations
from hgail_jax.recording import load_or_record
from hgail_jax.trainer.checkpoint import refuse_another_run
from hgail_jax.trainer.provenance import provenance
from hgail_jax.trainer.run_folder import sole_user
from hgail_jax.io.files import write_json
from hgail_jax.trainer.signals import stop_on_signal

_RESULTS = Path(__file__).resolve().parent / "results"
_QUICK_SEEDS = 2


@dataclasses.dataclass(frozen=True)
class Options:
    """Makes the paper's tables and figures. What is there already is left as it is."""

    table: tuple[Literal[1, 2, 3], ...] = ()
    """Tables: 1 the methods, 2 the curriculum, 3 future or final; a figure of the same training comes with each."""
    figure: tuple[Literal[3, 4, 5, 6, 7], ...] = ()
    """Figures: 3 the methods, 4 the curriculum, 5 future or final, 6 p_ht, 7 the rewards."""
    ablations: bool = False
    """One table of all ablations."""
    all: bool = False
    """Everything that the paper has on the task: all of the above on reach, table 1 on grasp."""
    longer: bool = True
    """With table 1, also train GASIL and PPO for 10 times the steps."""
    sweep: bool = False
    """Time 18 settings as one program against the same one after another."""
    plots_only: bool = False
    """Draw every figure again from the data in the folder; nothing is trained."""
    task: Literal["reach", "grasp", "point"] | None = None
    """The task; by default reach, or point with --quick."""
    seeds: int | None = None
    """Number of seeds: 8, or 2 with --quick."""
    quick: bool = False
    """Sizes that show in a minute or two that everything runs, and nothing else."""
    out: Path | None = None
    """Folder to write to: experiments/results, or runs/quick with --quick."""


@dataclasses.dataclass(frozen=True)
class Work:
    """What the options ask for, worked out."""

    task: str
    platform: str
    seeds: int
    quick: bool
    folder: Path
    studies: tuple[Study, ...]
    sweep: bool

    def sizes_of(self, preset: str) -> Sizes:
        """Returns a preset's sizes on the task."""
        return sizes(self.task, self.platform, self.quick, preset)

    @functools.cached_property
    def demonstrations(self) -> Demonstrations:
        """All demonstrations of the task; recorded where the folder has none."""
        path = self.folder / "demonstrations" / f"{self.task}.npz"
        return load_or_record(
            path, make_env(self.task, self.platform, 2 * MOST_DEMONSTRATIONS), self.task, MOST_DEMONSTRATIONS
        )

    def trial(self, setting: Setting) -> Trial:
        """Returns a setting worked out for the task."""
        count = setting.demonstrations
        identity = self.demonstrations.first(count).sha256 if count else None
        return work_out(self.task, setting, self.sizes_of, self.seeds, identity)


def plan(options: Options, platform: str) -> Work:
    """Works out what the options ask for on `"cpu"` or `"gpu"`.

    Raises:
      ValueError: they ask for nothing, or for what cannot be.

    """
    task = options.task or ("point" if options.quick else "reach")
    seeds = (_QUICK_SEEDS if options.quick else 8) if options.seeds is None else options.seeds
    check_seeds(0, seeds)
    everything = [study for study in STUDIES if task != "grasp" or study.table == 1]
    wanted = tuple(
        study
        for study in STUDIES
        if (options.longer or study.name != LONGER)
        and (
            (options.all and study in everything)
            or study.table in options.table
            or study.figure in options.figure
            or (options.ablations and study.name == "ablations")
        )
    )
    if not (wanted or options.sweep or options.plots_only):
        raise ValueError("nothing to make; name a --table or --figure, or --ablations, --all, --sweep or --plots-only")
    folder = options.out or (Path("runs") / "quick" if options.quick else _RESULTS)
    return Work(task, platform, seeds, options.quick, folder, wanted, options.sweep)


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
    groups = programs(trial for key, trial in trials.items() if not _part_path(work, key).exists())
    _write_complete(work, studies)
    for index, group in enumerate(groups):
        if stop.is_set():
            return
        names = "; ".join(_label(trial.setting) for trial in group)
        print(f"program {index + 1} of {len(groups)}: {names}", flush=True)
        env = make_env(work.task, work.platform, len(group) * work.seeds * group[0].config.num_envs)
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
    env = make_env(work.task, work.platform, len(trials) * work.seeds * trials[0].config.num_envs)
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


def _identities(trials: list[Trial]) -> dict[str, dict]:
    return {_label(trial.setting): trial.identity() for trial in trials}


def _label(setting: Setting) -> str:
    return ", ".join(filter(None, (setting.name, setting.panel)))


def _json_path(work: Work, study: Study) -> Path:
    return work.folder / f"{study.name}-{work.task}.json"


def _part_path(work: Work, key: str) -> Path:
    """Returns where a trial's result is kept until all that need it are written, and for those that come later."""
    return work.folder / "parts" / f"{key}.json"


def _read_json(path: Path) -> dict:
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is damaged, remove it: {error}") from None


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, "paper.py", __doc__, arguments)
    with contextlib.ExitStack() as held:
        try:
            work = plan(options, platform_name())
            if options.plots_only:
                return redraw(work.folder)
            (work.folder / "parts").mkdir(parents=True, exist_ok=True)
            held.enter_context(sole_user(work.folder))
            studies = unfinished(work)
        except (ValueError, OSError) as error:
            fail("paper.py", error, 2)
        try:
            with stop_on_signal() as stop:
                carry_out(work, studies, stop)
            if stop.is_set():
                print("stopped; the same command goes on")
            elif work.sweep:
                time_one_program(work)
        except OSError as error:
            fail("paper.py", f"stopped: {error}; the same command goes on", 1)


if __name__ == "__main__":
    cache_compilations()
    sys.path.append(os.getcwd())
    main()

"""Makes the paper's tables and figures: trains the methods they compare, and writes data, tables and pictures."""

import contextlib
import dataclasses
import os
import threading
from pathlib import Path
from typing import Annotated, Literal

import hgail_envs
from experiments.paper.spread import carry_out
from experiments.paper.studies import LONGER, STUDIES, studies_of
from experiments.paper.study import Study, choose_seeds
from experiments.paper.tables import write_means_over_tasks
from experiments.paper.trials import Scale
from experiments.paper.work import Unfinished, Work, redraw, time_one_program
from hgail_envs.validation import check_count, check_name
from hgail_jax.cli.command_line import fail, one_line_errors, parse, prepare_process
from hgail_jax.devices.gpus import visible_gpus
from hgail_jax.settings.defaults import platform_name
from hgail_jax.terminal.signals import stop_on_signal
from hgail_jax.trainer.folder import sole_user
from hgail_jax.trainer.options import unless_given

_PROGRAM = "paper"
_QUICK_SEEDS = 2


@dataclasses.dataclass(frozen=True)
class Options:
    """Makes the paper's tables and figures. Results that are there already are kept."""

    table: tuple[Literal[1, 2, 3], ...] = ()
    """Tables: 1 the methods, 2 the curriculum, 3 future or final; a figure of the same training comes with each."""
    figure: tuple[Literal[3, 4, 5, 6, 7], ...] = ()
    """Figures: 3 the methods, 4 the curriculum, 5 future or final, 6 p_ht, 7 the rewards."""
    study: tuple[str, ...] = ()
    """Studies by name, one table each: ablations (all of them), gasil (with the environment's reward), standardization
    (of rewards), parts (left out or changed, of a task with an object), off-policy, off-policy-sizes,
    off-policy-rewards and off-policy-methods (of the learner TD3), and those behind the tables and figures;
    paper-sizes, gail-demo-weight and grasp-sizes, which choose settings, on seeds of their own."""
    all: bool = False
    """All studies that are reported: all of the paper's on reach, table 1 on grasp, the parts on push,
    pick-and-place and slide."""
    longer: bool = True
    """Train GASIL and PPO for 10 times the steps too, with table 1."""
    sweep: bool = False
    """Time 18 settings as one program against the same one after another."""
    plots_only: bool = False
    """Draw every figure again from the data in the folder; nothing is trained."""
    task: tuple[str, ...] = ()
    """Tasks by name; by default reach, or point with --quick."""
    seeds: Annotated[int | None, unless_given("8; 4 where settings are chosen; 2 with --quick", "INT")] = None
    """Number of seeds."""
    processes: Annotated[int | None, unless_given("as many as GPUs", "INT")] = None
    """Programs to train at a time, each on a GPU of its own where there are any."""
    quick: bool = False
    """Take tiny sizes that show in a minute or two that everything runs."""
    out: Annotated[Path | None, unless_given("runs/paper; runs/quick with --quick", "FOLDER")] = None
    """Folder to write to."""


def plan(options: Options, platform: str) -> list[Work]:
    """Returns the work of each task that the options name, on `"cpu"` or `"gpu"`.

    Raises:
      ValueError: the options name no study, or an impossible one.

    """
    tasks = dict.fromkeys(options.task or (["point"] if options.quick else ["reach"]))
    seeds = _QUICK_SEEDS if options.quick and options.seeds is None else options.seeds
    choose_seeds(tuning=False, count=seeds)
    if options.processes is not None:
        check_count("processes", options.processes)
    for name in options.study:
        check_name("study", name, [study.name for study in STUDIES])
    folder = options.out or Path("runs") / ("quick" if options.quick else "paper")
    works = []
    for task in tasks:
        hgail_envs.find_class(task)
        studies = _wanted(options, task)
        for study in studies:
            _check_options(study, task)
        works.append(Work(Scale(task, platform, options.quick), seeds, folder, studies, options.sweep))
    if not (any(work.studies for work in works) or options.sweep or options.plots_only):
        raise ValueError("nothing to make; name a --table, a --figure or a --study, or --all, --sweep or --plots-only")
    return works


def _check_options(study: Study, task: str) -> None:
    asked = {option for setting in study.settings for option in setting.task_options}
    if lacking := asked - set(hgail_envs.accepted_options(task)):
        raise ValueError(f"study {study.name!r} is for tasks with the option {min(lacking)!r}; {task!r} has none")


def _wanted(options: Options, task: str) -> tuple[Study, ...]:
    return tuple(
        study
        for study in STUDIES
        if (options.longer or study.name != LONGER)
        and (
            (options.all and study in studies_of(task))
            or study.table in options.table
            or study.figure in options.figure
            or study.name in options.study
        )
    )


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, _PROGRAM, __doc__, arguments)
    gpus = _places(options)
    with contextlib.ExitStack() as held:
        try:
            works = plan(options, platform_name())
            if works[0].scale.platform == "cpu" and options.processes is None:
                gpus = gpus[:1]
            folder = works[0].folder
            if options.plots_only:
                return redraw(folder)
            (folder / "parts").mkdir(parents=True, exist_ok=True)
            held.enter_context(sole_user(folder))
            unfinished = [Unfinished(work) for work in works]
        except (ValueError, OSError) as error:
            fail(_PROGRAM, error, 2)
        try:
            with stop_on_signal() as stop:
                _carry_out(unfinished, gpus, stop)
            if stop.is_set():
                print("stopped; the same command goes on")
                return
            for study in works[0].studies if len(works) > 1 else ():
                write_means_over_tasks(folder, [work.task for work in works], study)
            for work in works if options.sweep else ():
                time_one_program(work)
        except (OSError, FloatingPointError, OverflowError) as error:
            fail(_PROGRAM, f"stopped: {error}; the same command goes on", 1)


def _places(options: Options) -> list[str]:
    """Returns the GPU of each process that trains; empty names on a machine without GPUs."""
    gpus = visible_gpus() or [""]
    count = len(gpus) if options.processes is None else max(options.processes, 1)
    if count > 1:  # JAX in this process must leave their memory to those that train
        os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    return [gpus[index % len(gpus)] for index in range(count)]


def _carry_out(unfinished: list[Unfinished], gpus: list[str], stop: threading.Event) -> None:
    """Trains the missing trials, and writes each study once all of its trials are there."""

    def write() -> None:
        for of_task in unfinished:
            of_task.write_complete()

    write()
    carry_out([job for of_task in unfinished for job in of_task.jobs()], gpus, stop, write)


if __name__ == "__main__":
    with one_line_errors(_PROGRAM):
        prepare_process()
        main()

"""Makes the paper's tables and figures: trains the methods they compare, and writes data, tables and pictures."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import hgail_envs
from experiments.paper.studies import LONGER, STUDIES, studies_of
from experiments.paper.study import Study, choose_seeds
from experiments.paper.trials import Scale, work_out
from experiments.paper.work import Unfinished, Work, carry_out, redraw, time_one_program
from hgail_envs.validation import check_name
from hgail_jax.cli.command_line import fail, one_line_errors, parse, prepare_process
from hgail_jax.settings.defaults import platform_name
from hgail_jax.terminal import stop_on_signal
from hgail_jax.trainer.folder import sole_user
from hgail_jax.trainer.train_options import unless_given

_PROGRAM = "paper"
_QUICK_SEEDS = 2


@dataclasses.dataclass(frozen=True)
class Options:
    """Makes the paper's tables and figures. Results that are there already are kept."""

    table: tuple[Literal[1, 2, 3], ...] = ()
    """Tables: 1 the methods, 2 the curriculum, 3 future or final; a figure of the same training comes with each."""
    figure: tuple[Literal[3, 4, 5, 6, 7, 8], ...] = ()
    """Figures: 3 the methods, 4 the curriculum, 5 future or final, 6 p_ht, 7 the rewards, 8 the methods by TD3 and
    contrastive RL."""
    study: tuple[str, ...] = ()
    """Studies by name, one table each: ablations (all of them), gasil (with the environment's reward), standardization
    (of rewards), parts (left out or changed, of a task with an object), off-policy, off-policy-samples,
    off-policy-sizes, off-policy-rewards and off-policy-methods (of the learner TD3), and those behind the tables and
    figures."""
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
    seeds: Annotated[int | None, unless_given("8; 2 with --quick", "INT")] = None
    """Number of seeds."""
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
    choose_seeds(seeds)
    for name in options.study:
        check_name("study", name, [study.name for study in STUDIES])
    folder = options.out or Path("runs") / ("quick" if options.quick else "paper")
    works = []
    for task in tasks:
        hgail_envs.find_class(task)
        studies, scale = _wanted(options, task), Scale(task, platform, options.quick)
        for study in studies:
            _check_options(study, task)
            _check_her(study, scale)
            _check_contrastive(study, scale)
        works.append(Work(scale, seeds, folder, studies, options.sweep))
    if not (any(work.studies for work in works) or options.sweep or options.plots_only):
        raise ValueError("nothing to make; name a --table, a --figure or a --study, or --all, --sweep or --plots-only")
    return works


def _check_options(study: Study, task: str) -> None:
    asked = {option for setting in study.settings for option in setting.task_options}
    if lacking := asked - set(hgail_envs.accepted_options(task)):
        raise ValueError(f"study {study.name!r} is for tasks with the option {min(lacking)!r}; {task!r} has none")


def _check_her(study: Study, scale: Scale) -> None:
    """Raises a ValueError if two rows of a study are HER with the same settings, by name or by the task's default."""
    names: dict[str, str] = {}
    for setting in study.settings:
        trial = work_out(scale, setting, range(1))
        if trial.method == "her" and (first := names.setdefault(trial.key(), setting.name)) != setting.name:
            raise ValueError(f"study {study.name!r} on {scale.task!r}: {first!r} and {setting.name!r} are both HER")


def _check_contrastive(study: Study, scale: Scale) -> None:
    """Raises a ValueError if a study has contrastive RL, and the task's observation depends on the goal."""
    for setting in study.settings:
        if setting.learner == "crl":
            work_out(scale, setting, range(1)).config.validate(scale.make_env(1))


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
    with contextlib.ExitStack() as held:
        try:
            works = plan(options, platform_name())
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
                carry_out(unfinished, stop)
            if stop.is_set():
                print("stopped; the same command resumes")
                return
            for work in works if options.sweep else ():
                time_one_program(work)
        except (OSError, FloatingPointError, OverflowError) as error:
            fail(_PROGRAM, f"stopped: {error}; the same command resumes", 1)


if __name__ == "__main__":
    with one_line_errors(_PROGRAM):
        prepare_process()
        main()

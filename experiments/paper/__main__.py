"""Makes the paper's tables and figures: trains what they compare, and writes data, tables and pictures."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Literal

import envs
from experiments.paper.studies import LONGER, STUDIES, studies_of
from experiments.paper.trials import Scale
from experiments.paper.work import Work, carry_out, redraw, time_one_program, unfinished
from hgail_jax.cli.command_line import fail, one_line_errors, parse, prepare_process
from hgail_jax.distributed.seeds import check_seeds
from hgail_jax.presets import platform_name
from hgail_jax.trainer.run_folder import sole_user
from hgail_jax.trainer.signals import stop_on_signal
from hgail_jax.validation import check_name

_PROGRAM = "paper"
_QUICK_SEEDS = 2


@dataclasses.dataclass(frozen=True)
class Options:
    """Makes the paper's tables and figures. What is there already is left as it is."""

    table: tuple[Literal[1, 2, 3], ...] = ()
    """Tables: 1 the methods, 2 the curriculum, 3 future or final; a figure of the same training comes with each."""
    figure: tuple[Literal[3, 4, 5, 6, 7], ...] = ()
    """Figures: 3 the methods, 4 the curriculum, 5 future or final, 6 p_ht, 7 the rewards."""
    study: tuple[str, ...] = ()
    """Studies by name, one table each: ablations (all of them), gasil (with the environment's reward), standardization
    (of rewards), and those behind the tables and figures."""
    all: bool = False
    """Everything that the paper has on the task: all of the above on reach, table 1 on grasp."""
    longer: bool = True
    """With table 1, also train GASIL and PPO for 10 times the steps."""
    sweep: bool = False
    """Time 18 settings as one program against the same one after another."""
    plots_only: bool = False
    """Draw every figure again from the data in the folder; nothing is trained."""
    task: str | None = None
    """The task's name; by default reach, or point with --quick."""
    seeds: int | None = None
    """Number of seeds: 8, or 2 with --quick."""
    quick: bool = False
    """Sizes that show in a minute or two that everything runs, and nothing else."""
    out: Path | None = None
    """Folder to write to: runs/paper, or runs/quick with --quick; the published one is experiments/results/paper."""


def plan(options: Options, platform: str) -> Work:
    """Works out what the options ask for on `"cpu"` or `"gpu"`.

    Raises:
      ValueError: they ask for nothing, or for what cannot be.

    """
    task = options.task or ("point" if options.quick else "reach")
    seeds = (_QUICK_SEEDS if options.quick else 8) if options.seeds is None else options.seeds
    check_seeds(0, seeds)
    envs.find_class(task)
    for name in options.study:
        check_name("study", name, [study.name for study in STUDIES])
    wanted = tuple(
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
    if not (wanted or options.sweep or options.plots_only):
        raise ValueError("nothing to make; name a --table, a --figure or a --study, or --all, --sweep or --plots-only")
    folder = options.out or Path("runs") / ("quick" if options.quick else "paper")
    return Work(Scale(task, platform, options.quick), seeds, folder, wanted, options.sweep)


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, _PROGRAM, __doc__, arguments)
    with contextlib.ExitStack() as held:
        try:
            work = plan(options, platform_name())
            if options.plots_only:
                return redraw(work.folder)
            (work.folder / "parts").mkdir(parents=True, exist_ok=True)
            held.enter_context(sole_user(work.folder))
            studies = unfinished(work)
        except (ValueError, OSError) as error:
            fail(_PROGRAM, error, 2)
        try:
            with stop_on_signal() as stop:
                carry_out(work, studies, stop)
            if stop.is_set():
                print("stopped; the same command goes on")
            elif work.sweep:
                time_one_program(work)
        except (OSError, FloatingPointError, OverflowError) as error:
            fail(_PROGRAM, f"stopped: {error}; the same command goes on", 1)


if __name__ == "__main__":
    with one_line_errors(_PROGRAM):
        prepare_process()
        main()

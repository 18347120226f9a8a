"""Measures speed: stepping, roll-outs, training, its scaling with seeds and devices, pictures, and whole runs."""

import dataclasses
import itertools
import os
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from experiments.bench import speed
from experiments.bench.pictures import measure_pictures
from experiments.bench.results import Results, table
from experiments.bench.scaling import measure_devices, measure_seeds
from experiments.bench.whole_runs import measure_compilation, measure_time_to_success
from experiments.bench.workload import Workload, default_preset, default_substeps
from hgail_envs import TASKS, find_class
from hgail_envs.engines import ENGINES
from hgail_envs.tasks.base import ArmEnv
from hgail_envs.validation import check_count, check_name
from hgail_envs.vision.look import LOOKS
from hgail_jax.cli.command_line import fail, one_line_errors, parse
from hgail_jax.io.provenance import provenance
from hgail_jax.settings.defaults import platform_name
from hgail_jax.trainer.train_options import unless_given

PROGRAM = "bench"

_OUT = Path("runs") / "bench" / "bench.json"
_QUICK_OUT = Path("runs") / "quick" / "bench.json"
_IMPLS = ("auto", *ENGINES)
_NUM_ENVS = {"cpu": (64,), "gpu": (1024, 4096, 16384, 65536)}
_QUICK_NUM_ENVS = (4,)
_QUICK_SEEDS = (1, 2)
_OF_WHOLE_RUNS = {"compile", "time-to-success"}


@dataclasses.dataclass(frozen=True)
class Options:
    """Measures speed and adds the rows to a file."""

    section: tuple[
        Literal["physics", "rollout", "train", "shares", "seeds", "devices", "pictures", "compile", "time-to-success"],
        ...,
    ] = ("physics", "rollout", "train", "shares")
    """Sections to measure. The first four are columns of one row for each size."""
    task: tuple[str, ...] = ("reach",)
    """Tasks, one after the other."""
    impl: Annotated[tuple[str, ...], tyro.conf.arg(help=f"Physics engines: {', '.join(_IMPLS)}.")] = ("auto",)
    num_envs: Annotated[tuple[int, ...] | None, unless_given("by platform", "INT [INT ...]")] = None
    """Environments, one row for each; for seeds and devices the first is the number per seed."""
    substeps: Annotated[tuple[int, ...] | None, unless_given("what the task is trained with", "INT [INT ...]")] = None
    """Physics steps per action, one row for each."""
    seeds: tuple[int, ...] = (1, 8)
    """Numbers of seeds to compare, the first of them 1."""
    picture_size: tuple[int, ...] = (64,)
    """Edges of pictures, one row for each."""
    look: str = "plain"
    """Look of the scenes in the pictures, as in hgail train."""
    run: tuple[str, ...] = ()
    """Further options of hgail train for compile and time-to-success, as one word each: --run=--num-envs=64."""
    quick: bool = False
    """Take tiny sizes that show that everything runs; the figures mean nothing."""
    out: Annotated[Path | None, unless_given(f"{_OUT}; {_QUICK_OUT} with --quick", "FILE")] = None
    """File to add to; its folder is made."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, PROGRAM, __doc__, arguments)
    try:
        _check(options)
        results = Results(options.out or (_QUICK_OUT if options.quick else _OUT))
        for row, made_by in measure(options):
            results.add(row | ({"quick": True} if options.quick else {}), made_by)
            print(table([row]), flush=True)
    except subprocess.CalledProcessError as error:
        raise SystemExit(error.returncode) from None  # the process has printed its error
    except (ValueError, OSError) as error:
        fail(PROGRAM, error, 2)
    except RuntimeError as error:  # most likely out of memory; the file has the rows before
        fail(PROGRAM, (str(error) or repr(error)).splitlines()[0], 1)
    for section in dict.fromkeys(row["section"] for row in results.added):
        rows = [row for row in results.added if row["section"] == section]
        if len(rows) > 1:  # one has been printed
            print(f"\n{table(rows)}")


def _check(options: Options) -> None:
    """Raises a ValueError if a list of options is empty or has an invalid value."""
    for name in ("section", "task", "impl", "seeds", "num_envs", "substeps", "picture_size"):
        if getattr(options, name) == ():
            raise ValueError(f"--{name.replace('_', '-')} names nothing")
    if options.run and not _OF_WHOLE_RUNS & set(options.section):
        raise ValueError(f"--run is for --section {' and '.join(sorted(_OF_WHOLE_RUNS))}")
    for task in options.task:
        check_name("task", task, [name for name in TASKS if issubclass(find_class(name), ArmEnv)])
    for impl in options.impl:
        check_name("impl", impl, _IMPLS)
    check_name("look", options.look, LOOKS)
    for name in ("seeds", "num_envs", "substeps", "picture_size"):
        for count in getattr(options, name) or ():
            check_count(name, count)
    if options.seeds[0] != 1:
        raise ValueError(f"seeds is {' '.join(map(str, options.seeds))}; the first must be 1")


def measure(options: Options) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Yields rows and their provenance."""
    # Runs in separate processes come first: until JAX's backend starts here, they have the GPU to themselves.
    for section, call in (("compile", measure_compilation), ("time-to-success", measure_time_to_success)):
        for task in options.task if section in options.section else ():
            row, made_by = call(task, options.run, options.quick)
            yield {"section": section, **row}, made_by
    for task in options.task:
        for row in _rows(options, task):
            yield row, provenance()


def _rows(options: Options, task: str) -> Iterator[dict[str, Any]]:
    """Yields a task's rows that are measured in this process."""
    sizes = options.num_envs or _NUM_ENVS[platform_name()]
    columns = [name for name in speed.COLUMNS if name in options.section]
    if columns:
        for workload in _workloads(options, task, sizes):
            yield {"section": "speed", **speed.speed_row(workload, columns)}
    if "pictures" in options.section:
        for workload in _workloads(options, task, sizes):
            for row in measure_pictures(workload, options.picture_size, options.look):
                yield {"section": "pictures", **row}
    per_seed = options.num_envs or (default_preset(task).config.num_envs,)
    for workload in _workloads(options, task, per_seed[:1]):
        if "seeds" in options.section:
            for row in measure_seeds(workload, _QUICK_SEEDS if options.quick else options.seeds):
                yield {"section": "seeds", **row}
        if "devices" in options.section:
            for row in measure_devices(workload):
                yield {"section": "devices", **row}


def _workloads(options: Options, task: str, num_envs: Sequence[int]) -> Iterator[Workload]:
    """Yields the options' workloads, for each engine, number of physics steps and number of environments."""
    substeps = options.substeps or (default_substeps(task, platform_name()),)
    counts = _QUICK_NUM_ENVS if options.quick else num_envs
    for impl, steps, count in itertools.product(options.impl, substeps, counts):
        yield Workload(task, impl, count, steps, options.quick)


if __name__ == "__main__":
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # MuJoCo Warp by itself needs memory beside JAX
    with one_line_errors(PROGRAM):
        main()

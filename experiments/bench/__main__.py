"""Measures speed: stepping, roll-outs and training beside the engine's bare loop, and beside other projects."""

import dataclasses
import json
import os
import subprocess
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

from hgail_jax.cli.command_line import fail, parse
from hgail_jax.io.files import write_json
from hgail_jax.validation import check_count

_RESULTS = Path(__file__).parent / "results" / "bench.json"
_QUICK = Path("runs") / "quick" / "bench.json"

_SPEED = ("physics", "rollout", "train", "shares")
_SAME = (
    "section",
    "task",
    "impl",
    "num_envs",
    "substeps",
    "seeds",
    "num_envs_per_seed",
    "devices",
    "what",
    "options",
    "quick",
)
"""Entries that tell rows apart; a row that agrees with an older one in these, and its device, takes its place."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Measures speed and writes what it finds to a file, beside what is there already."""

    section: tuple[
        Literal["physics", "rollout", "train", "shares", "seeds", "devices", "compile", "time-to-success", "peers"],
        ...,
    ] = ("physics", "rollout", "train", "shares")
    """What to measure. The first four are columns of one row for each size."""
    task: Literal["reach", "grasp"] = "reach"
    """The task."""
    impl: tuple[Literal["auto", "jax", "warp"], ...] = ("auto",)
    """Physics implementations."""
    num_envs: tuple[int, ...] | None = None
    """Environments, one row for each; for seeds and devices the first is the number per seed. Default by platform."""
    substeps: tuple[int, ...] | None = None
    """Physics steps per action, one row for each; by default what the task is trained with."""
    seeds: tuple[int, ...] = (1, 8)
    """Numbers of seeds to compare, the first of them 1."""
    run: tuple[str, ...] = ()
    """Further options of run.py for compile and time-to-success, as one word each: --run=--num-envs=64."""
    quick: bool = False
    """Takes sizes that show that everything runs, and measure nothing."""
    out: Path | None = None
    """File to add to: experiments/results/bench.json, or runs/quick/bench.json with --quick."""


class Results:
    """The rows in a JSON file; each is written as soon as it is there.

    Raises:
      ValueError: the file is there and is none of these.

    """

    def __init__(self, path: Path):
        self._path, self._rows = path, []
        self.added: list[dict] = []
        """The rows of this process."""
        if not path.parent.is_dir():
            raise ValueError(f"there is no folder {path.parent}")
        if path.exists():
            try:
                self._rows = json.loads(path.read_text())["rows"]
                for row in self._rows:
                    _key(row)
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise ValueError(f"{path} is no file of measurements: {error!r}") from None

    def add(self, row: dict, made_by: dict) -> None:
        """Adds a row, in place of an older one of the same."""
        self.added.append(row)
        row = row | {"made_by": made_by}
        self._rows = [old for old in self._rows if _key(old) != _key(row)] + [row]
        write_json(self._path, {"rows": self._rows})


def _key(row: dict) -> tuple:
    """Returns what a row that takes its place agrees in."""
    return *(row.get(name) for name in _SAME), json.dumps(row["made_by"]["device"], sort_keys=True)


def table(rows: list[dict]) -> str:
    """Returns rows as text: a line for each quantity, a column for each row."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [[name, *(_short(row.get(name, "")) for row in rows)] for name in names]
    widths = [max(len(line[column]) for line in cells) for column in range(len(rows) + 1)]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in cells)


def _short(value: Any) -> str:
    """Returns a number to three digits, anything else as it is.

    >>> _short(1234567.8), _short(0.98765), _short(4)
    ('1,230,000', '0.988', '4')
    """
    if not isinstance(value, float):
        return str(value)
    rounded = float(f"{value:.3g}")
    return f"{rounded:,.0f}" if abs(rounded) >= 100 else f"{rounded:g}"


def _sizes(options: Options) -> Iterator:
    """Yields the sizes that the options name, of the Fetch scenes."""
    from experiments.bench.speed import Size
    from experiments.paper.sizes import platform_name, sizes

    platform = platform_name()
    num_envs = options.num_envs or {"cpu": (64,), "gpu": (1024, 4096, 16384, 65536)}[platform]
    for impl in options.impl:
        for substeps in options.substeps or (sizes(options.task, platform).substeps,):
            for count in (4,) if options.quick else num_envs:
                yield Size(options.task, impl, count, substeps, options.quick)


def speed_rows(options: Options) -> Iterator[dict]:
    """Yields a row for each size, with the columns that the sections ask for and the ratios between them."""
    from experiments.bench.floors import measure_floors
    from experiments.bench.shares import measure_rollout, measure_training, shares
    from experiments.bench.speed import measure_physics

    wanted = set(_SPEED if "shares" in options.section else options.section)
    for size in _sizes(options):
        row: dict[str, Any] = {"section": "speed", "task": size.task, "impl": size.env.impl}
        row |= {
            "num_envs": size.num_envs,
            "substeps": size.substeps,
            "what": ", ".join(filter(wanted.__contains__, _SPEED)),
        }
        if "physics" in wanted:
            row |= measure_physics(size) | measure_floors(size)
        if "rollout" in wanted:
            row |= measure_rollout(size)
        if "train" in wanted:
            row |= measure_training(size, each_phase="shares" in wanted)
        if {"physics", "train"} <= wanted:
            row["train_to_raw"] = row["train_env_steps_per_second"] / row["raw_env_steps_per_second"]
        yield row | (shares(size, row) if set(_SPEED) <= wanted else {})


def peer_rows(task: str, quick: bool) -> Iterator[dict]:
    """Yields the rows of `peers`."""
    from experiments.bench import peers

    for row in peers.peer_rows(task, quick):
        yield {"section": "peers", **row}


def scaling_rows(options: Options, section: str) -> Iterator[dict]:
    """Yields the rows of `seeds` or `devices`."""
    import jax

    import envs
    from experiments.bench.scaling import measure_devices, measure_seeds
    from experiments.paper.sizes import platform_name
    from hgail_jax.presets import defaults

    default = defaults(envs.find_class(options.task), platform_name()).config["num_envs"]
    options = dataclasses.replace(options, num_envs=(options.num_envs or (default,))[:1])
    for size in _sizes(options):
        if section == "seeds":
            rows = measure_seeds(size, (1, 2) if options.quick else options.seeds)
        else:
            rows = measure_devices(size, jax.device_count())
        for row in rows:
            yield {"section": section, **row}


def measure(options: Options) -> Iterator[tuple[dict, dict]]:
    """Yields rows and what made them; the sections that start processes of their own come first."""
    whole = {"compile", "time-to-success"} & set(options.section)
    if whole:
        from experiments.bench.whole_runs import measure_compilation, measure_time_to_success

        small = ["--num-envs", "4", "--seeds", "2", "--iterations", "1"] if options.quick else []
        for section, call in (("compile", measure_compilation), ("time-to-success", measure_time_to_success)):
            if section in whole:
                row, made_by = call(options.task, [*small, *options.run])
                given = {"options": " ".join(options.run)} if options.run else {}
                yield {"section": section, **row, **given}, made_by
    from hgail_jax.trainer.provenance import provenance

    sections: list[tuple[bool, Callable[[], Iterable[dict]]]] = [
        (bool(set(_SPEED) & set(options.section)), lambda: speed_rows(options)),
        ("seeds" in options.section, lambda: scaling_rows(options, "seeds")),
        ("devices" in options.section, lambda: scaling_rows(options, "devices")),
        ("peers" in options.section, lambda: peer_rows(options.task, options.quick)),
    ]
    for wanted, rows in sections:
        for row in rows() if wanted else ():
            yield row, provenance()


def _check(options: Options) -> None:
    """Raises a ValueError if a list of options is empty or holds a number that it cannot have."""
    for name in ("section", "impl", "seeds"):
        if not getattr(options, name):
            raise ValueError(f"--{name} names nothing")
    for name in ("seeds", "num_envs", "substeps"):
        for count in getattr(options, name) or ():
            check_count(name, count)
    if options.seeds[0] != 1:
        raise ValueError(f"seeds is {' '.join(map(str, options.seeds))}; the first must be 1")


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, "bench.py", __doc__, arguments)
    try:
        _check(options)
        if options.quick and options.out is None:
            _QUICK.parent.mkdir(parents=True, exist_ok=True)
        results = Results(options.out or (_QUICK if options.quick else _RESULTS))
        for row, made_by in measure(options):
            results.add(row | ({"quick": True} if options.quick else {}), made_by)
            print(table([row]), flush=True)
    except subprocess.CalledProcessError as error:
        raise SystemExit(error.returncode) from None  # it has said what is wrong
    except (ValueError, OSError) as error:
        fail("bench.py", error, 2)
    except RuntimeError as error:  # out of memory, most likely; what was measured before is in the file
        fail("bench.py", (str(error) or repr(error)).splitlines()[0], 1)
    for section in dict.fromkeys(row["section"] for row in results.added):
        print(f"\n{table([row for row in results.added if row['section'] == section])}")


if __name__ == "__main__":
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # MuJoCo Warp by itself needs memory beside JAX
    main()

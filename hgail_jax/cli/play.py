"""Rolls out a trained policy: in MuJoCo's viewer where there is a display, else as a film."""

import dataclasses
import os
from pathlib import Path

import envs
from envs.scenes import assets_directory
from hgail_jax.cli.command_line import fail, one_line_errors, parse, prepare_process
from hgail_jax.io.policy import MeanPolicy, load_policy
from hgail_jax.playback import film, show
from hgail_jax.validation import MOST_SEED, check_count

PROGRAM = "hgail play"


@dataclasses.dataclass(frozen=True)
class Options:
    """Rolls out a trained policy: in MuJoCo's viewer where there is a display, else as a film."""

    task: str = "grasp"
    """A task with a scene, e.g. reach or grasp."""
    policy: Path | None = None
    """The policy's file; by default the one that comes with the package."""
    episodes: int = 3
    """Episodes to play."""
    seed: int = 0
    """Of the episodes."""
    out: Path | None = None
    """Film to write instead of opening the viewer; without a display <task>.mp4 by default."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, PROGRAM, __doc__, arguments)
    try:
        check_count("episodes", options.episodes)
        check_count("seed", options.seed, least=0, most=MOST_SEED)
        env, policy = _load(options)
    except (ValueError, OSError) as error:
        fail(PROGRAM, error, 2)
    if options.out is None and os.environ.get("DISPLAY"):
        outcomes = show(env, policy, options.episodes, options.seed)
    else:
        path = options.out or Path(f"{options.task}.mp4")
        print(f"compiling, then filming {options.episodes} episodes of {options.task} ...", flush=True)
        try:
            outcomes = film(path, env, policy, options.episodes, options.seed)
        except (RuntimeError, OSError, ValueError) as error:
            fail(PROGRAM, error, 1)
        print(path)
    print(f"{sum(outcomes)} of {len(outcomes)} episodes succeeded")


def _load(options: Options) -> tuple[envs.GoalEnv, MeanPolicy]:
    """Returns the task and the policy.

    Raises:
      ValueError: the task has no scene, or the policy is not for it.
      OSError: the policy's file cannot be read.

    """
    if envs.find_class(options.task).scene is None:
        shown = [task for task in envs.TASKS if envs.find_class(task).scene]
        raise ValueError(f"task {options.task!r} has no scene to show; choose from {', '.join(shown)}")
    policy = load_policy(options.policy or assets_directory() / "policies" / f"{options.task}.npz")
    env = envs.make(options.task)
    if policy.task != options.task or policy.observation_size != env.observation_size:
        raise ValueError(f"the policy is for {policy.task!r}, not for {options.task!r}")
    return env, policy


if __name__ == "__main__":
    with one_line_errors(PROGRAM):
        prepare_process()
        main()

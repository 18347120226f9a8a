"""Rolls out a trained policy on the CPU: in MuJoCo's viewer where there is a display, else as a film."""

import dataclasses
import os
from pathlib import Path

import envs
from envs.fetch.arm import FetchEnv
from hgail_jax.cli.command_line import fail, parse
from hgail_jax.io.policy import load_policy
from hgail_jax.playback import film, show
from hgail_jax.validation import check_count

RESULTS = Path(__file__).parent / "results"


@dataclasses.dataclass(frozen=True)
class Options:
    """Rolls out a trained policy: in MuJoCo's viewer where there is a display, else as a film."""

    task: str = "grasp"
    """A Fetch task: reach, or grasp."""
    policy: Path | None = None
    """The policy's file; by default the one that comes with the repository."""
    episodes: int = 3
    """Episodes to play."""
    seed: int = 0
    """Of the episodes."""
    out: Path | None = None
    """Film to write instead of opening the viewer; without a display <task>.mp4 by default."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, "play.py", __doc__, arguments)
    try:
        check_count("episodes", options.episodes)
        check_count("seed", options.seed, least=0)
        if not issubclass(envs.find_class(options.task), FetchEnv):
            raise ValueError(f"task {options.task!r} has no scene to show; choose reach or grasp")
        policy = load_policy(options.policy or RESULTS / f"{options.task}-hgail" / "policies" / "seed-0.npz")
        env = envs.make(options.task, impl="jax")
        if policy.task != options.task or policy.observation_size != env.observation_size:
            raise ValueError(f"the policy is for {policy.task!r}, not for {options.task!r}")
    except (ValueError, OSError) as error:
        fail("play.py", error, 2)
    if options.out is None and os.environ.get("DISPLAY"):
        outcomes = show(env, policy, options.episodes, options.seed)
    else:
        path = options.out or Path(f"{options.task}.mp4")
        print(f"compiling, then filming {options.episodes} episodes of {options.task} ...", flush=True)
        try:
            outcomes = film(path, env, policy, options.episodes, options.seed)
        except (RuntimeError, OSError, ValueError) as error:
            fail("play.py", error, 1)
        print(path)
    print(f"{sum(outcomes)} of {len(outcomes)} episodes succeeded")


if __name__ == "__main__":
    main()

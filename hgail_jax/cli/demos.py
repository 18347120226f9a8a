"""Records demonstrations of a task by a scripted controller."""

import dataclasses
import os
import sys
from pathlib import Path

from experiments.paper.sizes import make_env, platform_name
from hgail_jax.cli.command_line import cache_compilations, fail, parse
from hgail_jax.io.demonstrations import save_demonstrations
from hgail_jax.recording import record
from hgail_jax.validation import check_count

_MOST_SEED = 2**31 - 1


@dataclasses.dataclass(frozen=True)
class Options:
    """Records demonstrations of a task by a scripted controller."""

    task: str = "reach"
    """A task that has a controller: reach, grasp or point."""
    episodes: int = 100
    """Successful episodes to record; the first of them are the smaller sets."""
    seed: int = 0
    """Seed of the episodes."""
    out: Path | None = None
    """File to write, which must not exist; by default demonstrations/<task>.npz."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, "demos.py", __doc__, arguments)
    path = options.out or Path("demonstrations") / f"{options.task}.npz"
    try:
        check_count("episodes", options.episodes)
        check_count("seed", options.seed, least=0, most=_MOST_SEED)
        if path.exists():
            raise ValueError(f"{path} exists already; name another file")
        demonstrations = record(
            make_env(options.task, platform_name(), 2 * options.episodes + 4),
            options.task,
            options.episodes,
            options.seed,
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        save_demonstrations(path, demonstrations)
    except (ValueError, OSError) as error:
        fail("demos.py", error, 2)
    print(
        f"{options.episodes} episodes of {options.task}: return {demonstrations.returns.mean():.1f},"
        f" L1 distance {demonstrations.distance_l1.mean():.4f} m -> {path}"
    )


if __name__ == "__main__":
    cache_compilations()
    sys.path.append(os.getcwd())
    main()

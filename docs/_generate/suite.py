"""Writes the tables about the Fetch suite, as Markdown, from what was measured."""

from docs._generate.results import count, fixed, read_json, seconds
from docs._generate.tables import markdown


def suite() -> str:
    """Eight seeds of each task of the Fetch suite on one H200."""
    rows = [read_json(f"runs/{task}-hgail/summary") for task in ("reach", "grasp", "push", "pick-and-place")]
    header = ["task", "success", "worst seed", "L1 distance", "env steps per seed", "training", "start to end"]
    return markdown(
        header,
        [
            [
                row["task"],
                f"{fixed(row['success_rate']['mean'], 3)} ± {fixed(row['success_rate']['std'], 3)}",
                fixed(min(row["success_rate"]["per_seed"]), 3),
                f"{fixed(row['distance_l1']['mean'], 3)} m",
                count(row["env_steps_per_seed"]),
                *(seconds(row["wall_seconds"][what]) for what in ("train", "total")),
            ]
            for row in rows
        ],
    )


def official() -> str:
    """Policies run unchanged in Gymnasium-Robotics' environments."""
    return markdown(
        ["task", "success", "95 % interval", "episodes"],
        [
            [
                row["task"],
                fixed(row["success_rate"], 3),
                f"{fixed(row['success_low'], 3)} to {fixed(row['success_high'], 3)}",
                str(row["episodes"]),
            ]
            for row in read_json("suite/gymnasium")["rows"]
        ],
    )


def each_seed(table: str) -> str:
    """Returns a table of `suite/`: settings, and the success of each of their seeds."""
    return markdown(
        ["setting", "success", "of each seed"],
        [
            [
                row["setting"],
                fixed(row["success_rate"], 2),
                ", ".join(fixed(value, 2) for value in row["success_per_seed"]),
            ]
            for row in read_json(f"suite/{table}")["rows"]
        ],
    )


def networks() -> str:
    """Rounds until each seed first reached a success, for two widths of the networks."""
    return markdown(
        ["task", "width", "seeds", "success", "rounds"],
        [
            [
                row["task"],
                str(row["width"]),
                "{} to {}".format(*row["seeds"]),
                fixed(row["success"], 2),
                ", ".join("never" if rounds is None else str(rounds) for rounds in row["rounds_until"]),
            ]
            for row in read_json("suite/networks")["rows"]
        ],
    )


def grasp_on_two_cores() -> str:
    """Sizes that were tried for grasp on a CPU."""
    return markdown(
        ["environments", "rounds", "likelihood weight", "seeds", "success", "worst seed", "env steps per seed"],
        [
            [
                str(row["num_envs"]),
                str(row["rounds"]),
                f"{row['likelihood_weight']:g}",
                "{} to {}".format(*row["seeds"]),
                fixed(row["success_rate"], 3),
                fixed(row["worst_seed"], 3),
                count(row["env_steps"]),
            ]
            for row in read_json("suite/grasp-on-two-cores-tuning")["rows"]
        ],
    )

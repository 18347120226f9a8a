"""Writes the tables about the Fetch suite, as Markdown."""

from docs._generate.results import Row, count, fixed, mean, of_seeds, pick, rate, read_csv, read_json, seconds, trials
from docs._generate.tables import markdown, reward

_RUNS = ("reach-hgail", "grasp-hgail", "push-td3", "pick-and-place-td3", "slide-td3")
TASKS = ("reach", "grasp", "push", "pick-and-place", "slide")


def suite() -> str:
    """Eight seeds of each task of the Fetch suite, by the task's default learner."""
    rows = [read_json(f"runs/{run}/summary") for run in _RUNS]
    header = ["task", "learner", "reward", "success", "worst seed", "L1 distance", "env steps", "training", "whole run"]
    return markdown(
        header,
        [
            [
                row["task"],
                row.get("learner", "ppo").upper(),
                reward(row),
                of_seeds(row["success_rate"]),
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
            for row in read_json("suite/tasks")["gymnasium"]["rows"]
        ],
    )


def each_seed(task: str, part: str = "tuning") -> str:
    """Returns a part of a task's file in `suite/`: settings, and the success of each of their seeds."""
    return markdown(
        ["setting", "success", "of each seed"],
        [
            [
                row["setting"],
                fixed(row["success_rate"], 2),
                ", ".join(fixed(value, 2) for value in row["success_per_seed"]),
            ]
            for row in read_json(f"suite/{task}")[part]["rows"]
        ],
    )


def parts(task: str) -> str:
    """Success of a task with a part of the method left out or changed."""
    rows = trials(f"parts-{task}")
    hgail = pick(rows, setting="HGAIL")["better_than"]
    rows.sort(key=lambda row: -row["success_rate"])
    return markdown(
        ["setting", "success", "IQM, 95 % interval", "of each seed", "HGAIL is better"],
        [
            [
                row["setting"] + (" (older)" if row["older"] else ""),
                fixed(row["success_rate"], 3),
                "{}, {} to {}".format(*(fixed(row[f"success_iqm{end}"], 3) for end in ("", "_low", "_high"))),
                ", ".join(fixed(each, 2) for each in row["final"]["success"]),
                fixed(hgail[row["setting"]][0], 2) if row["setting"] in hgail else "",
            ]
            for row in rows
        ],
    )


def parts_of_all() -> str:
    """Success on each task of `parts`, with a part of the method left out or changed."""
    tasks = ("push", "pick-and-place", "slide")
    columns = [{row["setting"]: fixed(row["success_rate"], 3) for row in trials(f"parts-{task}")} for task in tasks]
    return markdown(
        ["setting", *tasks], [[setting, *(column[setting] for column in columns)] for setting in columns[0]]
    )


def slide_elsewhere() -> str:
    """Success on slide and on its relatives as others published it, and whether it can be compared."""
    columns = ("what", "success", "env_steps", "comparable", "source")
    header = ["what", "success", "env steps", "comparable?", "source"]
    rows = read_json("suite/published")["slide_and_its_relatives"]
    return markdown(header, [[row[name] for name in columns] for row in rows])


def published() -> str:
    """Success over environment steps and over time, here and as others published it."""
    here = [_ours(*each) for each in _OURS]
    rows = read_json("suite/published")["rows"] + here
    rows.sort(key=lambda row: TASKS.index(row["task"]))
    header = ["task", "what", "success", "env steps per seed", "time", "source"]
    return markdown(
        header, [[row[name] for name in ("task", "what", "success", "env_steps", "time", "source")] for row in rows]
    )


_OURS = (  # task, run, what it is, GPU, and the success looked for
    ("push", "push-td3", "HGAIL with TD3, here", "H100", 0.95),
    ("push", "push-hgail", "HGAIL with PPO, here", "H200", 0.95),
    ("pick-and-place", "pick-and-place-td3", "HGAIL with TD3 and a quarter of the goal test, here", "H100", 0.95),
    ("pick-and-place", "pick-and-place-td3-no-reward", "HGAIL with TD3, here", "H100", 0.95),
    ("pick-and-place", "pick-and-place-hgail", "HGAIL with PPO, here", "H200", 0.95),
    ("slide", "slide-td3", "TD3 with hindsight, here", "H100", 0.80),
    ("slide", "slide-td3", "TD3 with hindsight, here", "H100", None),
    ("slide", "slide-hgail", "HGAIL with PPO, here", "H200", None),
)


def _ours(task: str, run: str, what: str, gpu: str, least: float | None) -> Row:
    """Returns when the mean of a run's seeds reached a success, or how the run ended where `least` is None."""
    rows = [row for row in read_csv(f"runs/{run}/metrics") if row["success_rate"] != ""]
    steps = sorted({row["env_steps"] for row in rows})
    curve = {each: mean([row["success_rate"] for row in rows if row["env_steps"] == each]) for each in steps}
    there = steps[-1] if least is None else next(each for each in steps if curve[each] >= least)
    success = read_json(f"runs/{run}/summary")["success_rate"]["mean"] if least is None else least
    taken = pick(rows, env_steps=there, seed=0)["seconds"]
    return {
        "task": task,
        "what": what,
        "success": fixed(success, 2),
        "env_steps": rate(there),
        "time": f"{seconds(taken)} for eight seeds on one {gpu}",
        "source": "",
    }


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
            for row in read_json("suite/tasks")["networks"]["rows"]
        ],
    )


def grasp_on_two_cores() -> str:
    """Sizes that were tried for grasp on a CPU."""
    return markdown(
        ["environments", "rounds", "BC weight", "seeds", "success", "worst seed", "env steps per seed"],
        [
            [
                str(row["num_envs"]),
                str(row["rounds"]),
                f"{row['bc_weight']:g}",
                "{} to {}".format(*row["seeds"]),
                fixed(row["success_rate"], 3),
                fixed(row["worst_seed"], 3),
                count(row["env_steps"]),
            ]
            for row in read_json("suite/grasp")["on_two_cores"]["rows"]
        ],
    )


def push_on_two_cores() -> str:
    """Sizes that were tried for push on a CPU."""
    return markdown(
        ["environments", "rounds", "BC weight", "seed", "success", "env steps", "start to end"],
        [
            [
                str(row["num_envs"]),
                str(row["rounds"]),
                f"{row['bc_weight']:g}",
                str(row["seed"]),
                fixed(row["success_rate"], 3),
                count(row["env_steps"]),
                seconds(row["total_seconds"]),
            ]
            for row in read_json("suite/push")["on_two_cores"]["rows"]
        ],
    )

"""Writes the tables of the paper's studies, as Markdown."""

from docs._generate.results import (
    Row,
    count,
    fixed,
    mean,
    of_seeds,
    pick,
    read_csv,
    read_json,
    seconds,
    success,
    trial,
    trials,
)
from experiments.paper.markdown import label, study_table, table

_UNBROKEN = "\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}"
_HEADER = {
    "label": "setting",
    "paper_success": "success: paper",
    "success": "here",
    "worst_seed": "worst seed",
    "paper_distance_l1": "L1 (m): paper",
    "distance_l1_mean": "here",
    "env_steps": "env steps per seed",
}


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """Returns a Markdown table between blank lines, which keep it off a comment's line.

    >>> print(markdown(["a", "b"], [["1", "2"]]).strip())
    | a | b |
    |---|---|
    | 1 | 2 |
    """
    return _framed(table(header, rows))


def _framed(table: str) -> str:
    return f"\n\n{table.replace(' ± ', _UNBROKEN)}\n\n"


def methods(task: str, *more: tuple[str, str, str]) -> str:
    """Table 1 of a task with the longer runs, and `more` rows, each given as study, setting and panel."""
    return studied([*trials(f"table1-{task}"), *trials(f"table1-longer-{task}"), *(trial(*each) for each in more)])


def study(name: str) -> str:
    """Returns the whole table of a study, e.g. `"table2-reach"`."""
    return studied(trials(name))


def studied(rows: list[Row]) -> str:
    """Returns rows of studies beside the paper's, HGAIL's first; those of another commit than its are older."""
    rows = sorted(rows, key=lambda row: not row["setting"].startswith("HGAIL"))
    labels = [label(row | {"panel": row["panel"].replace("variants", "")}) for row in rows]
    older = ["" if row["commit"] == rows[0]["commit"] else " (older)" for row in rows]
    labelled = [row | {"label": name + mark} for row, name, mark in zip(rows, labels, older, strict=True)]
    return _framed(study_table(labelled, _HEADER))


def tried() -> str:
    """Settings that were tried on grasp; the standard deviations are of x, y, z and of the hand."""
    return markdown(
        ["σ of x, y, z; hand", "BC weight", "PPO", "success of the two seeds", "L1 distance"],
        [
            [
                "{}; {}".format(row["action_std"][0], row["action_std"][-1]),
                f"{row['bc_weight']:g}",
                "yes" if row["ppo_weight"] else "no",
                ", ".join(fixed(each, 2) for each in row["success_per_seed"]),
                f"{fixed(row['distance_l1'], 3)} m",
            ]
            for row in read_json("suite/grasp")["tried"]["rows"]
        ],
    )


def older() -> str:
    """Older runs of grasp, with other settings than the default."""
    return markdown(
        ["what", "success of the seeds", "L1 distance"],
        [
            [
                row["what"],
                ", ".join(fixed(each, 2) for each in row["success_per_seed"]),
                f"{fixed(row['distance_l1'], 3)} m",
            ]
            for row in read_json("suite/grasp")["older"]["rows"]
        ],
    )


def paper_sizes(least: float = 0.1) -> str:
    """Success on reach of single changes to the paper's sizes; those below `least` are one row."""
    rows = trials("paper-sizes-reach")
    taught, untaught = (
        [row for row in rows if row["panel"] == f"{with_} pre-training"] for with_ in ("with", "without")
    )
    both = [(row, pick(untaught, setting=row["setting"])) for row in taught]
    vain = [pair for pair in both[1:] if max(row["success_rate"] for row in pair) < least]
    shown = sorted((pair for pair in both[1:] if pair not in vain), key=lambda pair: -pair[0]["success_rate"])
    most = [fixed(max(pair[index]["success_rate"] for pair in vain), 2) for index in (0, 1)]
    steps = [row["env_steps_per_seed"] for row, _ in vain]
    others = [
        f"each of {len(vain)} others",
        f"{count(min(steps))} to {count(max(steps))}",
        *(f"at most {m}" for m in most),
    ]
    cells = [
        [row["setting"], count(row["env_steps_per_seed"]), _with_seeds(row), _with_seeds(other)]
        for row, other in [both[0], *shown]
    ]
    header = ["change", "env steps per seed, with pre-training", "success with it (of each seed)", "without"]
    return markdown(header, [cells[0], others, *cells[1:]])


def second_change() -> str:
    """Success on reach of a second change to the paper's sizes, after phases 1 + 3."""
    rows = [row for row in trials("paper-sizes-reach") if row["panel"] == "phases 1 + 3"]
    cells = [
        [row["setting"].replace("as they are", "none"), count(row["env_steps_per_seed"]), _with_seeds(row)]
        for row in rows
    ]
    return markdown(["second change", "env steps per seed", "success (of each seed)"], cells)


def _with_seeds(row: Row) -> str:
    return f"{fixed(row['success_rate'], 2)} ({', '.join(fixed(each, 2) for each in row['final']['success'])})"


def grasp_sizes() -> str:
    """Success of smaller trainings of grasp on the tuning seeds: their mean and the worst."""
    rows = trials("grasp-sizes-grasp")
    weights = list(dict.fromkeys(row["setting"] for row in rows))
    cells = []
    for panel in dict.fromkeys(row["panel"] for row in rows):
        of_panel = [pick(rows, panel=panel, setting=weight) for weight in weights]
        ends = [f"{fixed(row['success_rate'], 3)} ({fixed(row['worst_seed'], 3)})" for row in of_panel]
        cells.append([panel, *ends, count(of_panel[0]["env_steps_per_seed"]), of_panel[0]["commit"]])
    return markdown(["sizes", *weights, "env steps per seed", "commit"], cells)


def smaller_trainings() -> str:
    """Runs of smaller trainings of grasp on a GPU."""
    trainings = read_json("suite/grasp")["smaller_trainings"]
    wanted = f"every seed has {fixed(trainings['wanted'], 2)} after"
    return markdown(
        ["sizes", "seeds", wanted, "training in all", "success", "worst seed", "commit"],
        [
            [
                row["sizes"],
                f"{row['seeds'][0]} to {row['seeds'][-1]}",
                seconds(row["seconds_until_every_seed"]) if row["seconds_until_every_seed"] else "never",
                seconds(row["train_seconds"]),
                *(fixed(row[f"final_success_{what}"], 3) for what in ("mean", "worst_seed")),
                row["made_by"]["commit"],
            ]
            for row in trainings["runs"]
        ],
    )


_HEADLINE = (  # a run, its task's name, and the methods whose figures stand beside it
    ("reach-hgail", "reach", ("the paper",)),
    ("grasp-hgail", "grasp, with a lift test", ("the paper",)),
    ("grasp-td3", "grasp, told at each step where the cube is", ()),
    ("push-td3", "push", ("RHER", "DDPG + HER")),
    ("pick-and-place-td3-no-reward", "pick and place", ("RHER", "DDPG + HER")),
    ("pick-and-place-td3", "pick and place", ("RHER", "DDPG + HER")),
    ("slide-td3", "slide", ("TQC + HER",)),
    ("slide-hgail", "slide", ("TQC + HER",)),
    ("stack-td3", "put a cube on another, and let go", ()),
    ("tower-td3", "put three cubes on one another, in a given order", ()),
)


def headline() -> str:
    """Figures of the front page, the unflattering ones too."""
    header = ["task", "learner", "reward", "success", "steps to .95", "steps in all", "training", "elsewhere"]
    sizes = trial("ablations-reach", "the paper's sizes", "with pre-training")
    steps = ["never", count(sizes["env_steps_per_seed"]), ""]
    last = ["reach with the paper's own sizes", "PPO", "none", success(sizes), *steps, _elsewhere("reach", "the paper")]
    return markdown(header, [*(_front(*each) for each in _HEADLINE), last])


def steps_to(run: str, least: float = 0.95) -> int | None:
    """Returns the steps of a seed after which the mean of a run's seeds was first measured at `least`, or None."""
    rows = [row for row in read_csv(f"runs/{run}/metrics") if row["success_rate"] != ""]
    steps = sorted({row["env_steps"] for row in rows})
    means = ((each, mean([row["success_rate"] for row in rows if row["env_steps"] == each])) for each in steps)
    return next((int(each) for each, success in means if success >= least), None)


def steps_told(run: str) -> str:
    """Returns what `steps_to` does, as a table has it."""
    steps = steps_to(run)
    return "never" if steps is None else count(steps)


def _front(run: str, name: str, elsewhere: tuple[str, ...]) -> list[str]:
    row = read_json(f"runs/{run}/summary")
    return [
        name,
        row.get("learner", "ppo").upper(),
        reward(row),
        of_seeds(row["success_rate"]),
        steps_told(run),
        count(row["env_steps_per_seed"]),
        seconds(row["wall_seconds"]["train"]),
        "; ".join(_elsewhere(row["task"], what) for what in elsewhere),
    ]


def reward(summary: Row) -> str:
    """Returns what a run's policy was rewarded for, beside the discriminator's reward.

    >>> reward({"environment_reward": 0.25}), reward({"environment_reward": 1.0}), reward({})
    ('goal test × 0.25', 'goal test alone', 'none')
    """
    weight = summary.get("environment_reward", 0.0)
    if weight == 1.0:
        return "goal test alone"
    return f"goal test × {fixed(weight, 2)}" if weight else "none"


def _elsewhere(task: str, what: str) -> str:
    if what == "the paper":
        return f"{trial(f'table1-{task}', 'HGAIL')['paper_success']}, {what}"
    row = pick(read_json("suite/published")["rows"], task=task, what=what)
    return f"{row['success']} after {row['env_steps']}, {what}"

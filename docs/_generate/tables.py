"""Writes the tables of the documentation, as Markdown, from what was measured."""

import math
import statistics
from typing import Any

from docs._generate.results import (
    Row,
    bench,
    count,
    fixed,
    of_seeds,
    pick,
    rate,
    read_csv,
    read_json,
    seconds,
    start,
    success,
    trial,
    trials,
)

_UNBROKEN = "\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}"


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """Returns a Markdown table, with blank lines around it: it must not stand on a comment's line.

    >>> print(markdown(["a", "b"], [["1", "2"]]).strip())
    | a | b |
    |---|---|
    | 1 | 2 |
    """
    lines = [header, *rows]
    text = ["| " + " | ".join(line).replace(" ± ", _UNBROKEN) + " |" for line in lines]
    return "\n\n" + "\n".join([text[0], "|" + "---|" * len(header), *text[1:]]) + "\n\n"


def methods(task: str, *more: tuple[str, str, str]) -> str:
    """Table 1 of a task, the runs of more steps, and `more` rows, each a table, a setting and a panel."""
    return studied([*trials(f"table1-{task}"), *trials(f"table1-longer-{task}"), *(trial(*each) for each in more)])


def study(table: str) -> str:
    """Returns a whole table of `paper/`, e.g. `"table2-reach"`."""
    return studied(trials(table))


def studied(rows: list[Row]) -> str:
    """Returns rows of `paper/` beside the paper's, HGAIL's first; those of another commit than its are older."""
    rows = sorted(rows, key=lambda row: not row["setting"].startswith("HGAIL"))
    header = ["setting", "success: paper", "here", "worst seed", "L1 (m): paper", "here", "env steps per seed"]
    return markdown(
        header,
        [
            [
                ", ".join(filter(None, (row["setting"], row["panel"].replace("variants", ""))))
                + ("" if row["commit"] == rows[0]["commit"] else " (older)"),
                row["paper_success"],
                success(row),
                fixed(row["worst_seed"], 3),
                row["paper_distance_l1"],
                fixed(row["distance_l1"], 3),
                count(row["env_steps_per_seed"]),
            ]
            for row in rows
        ],
    )


def tried() -> str:
    """What was tried on grasp; the standard deviations are of x, y, z and of the hand."""
    return markdown(
        ["σ of x, y, z; hand", "weight of the likelihood", "PPO", "success of the two seeds", "L1 distance"],
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
    """Older runs of grasp, less or other than the default."""
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


def time_to_success() -> str:
    """How long eight seeds take on one H200."""
    rows = [bench(section="time-to-success", task=task, platform="gpu") for task in ("reach", "grasp")]
    header = ["task", "until every seed has", "this takes", "training in all", "compilation", "start to end"]
    return markdown(
        [*header, "success in the end"],
        [
            [
                row["task"],
                fixed(row["wanted"], 2),
                seconds(row["seconds_until_every_seed"]),
                *(seconds(row[f"{what}_seconds"]) for what in ("train", "compile", "total")),
                fixed(row["final_success_mean"], 3),
            ]
            for row in rows
        ],
    )


def compilation() -> str:
    """What caches save at the start of a run, on two hosts."""
    caches = {
        "uncached": "nothing",
        "kernels-cached": "MuJoCo Warp's kernels",
        "programs-cached": "the programs",
        "cached": "both",
    }
    cells = []
    for state, name in caches.items():
        starts = [start(f"{host}{state}")["wall_seconds"] for host in ("", "other-host-")]
        cells.append([name, *(seconds(spent[what]) for spent in starts for what in ("compile", "total"))])
    commits = [start(f"{host}cached")["commit"] for host in ("", "other-host-")]
    header = [f"compilation, {name} ({commit})" for name, commit in zip(("one host", "another"), commits, strict=True)]
    return markdown(["cached", header[0], "start to end", header[1], "start to end"], cells)


def stepping() -> str:
    """Env steps per second of physics and of training, by MJX-Warp on one H200."""
    rows = [row for row in read_json("bench/bench")["rows"] if row["section"] == "speed" and row["impl"] == "warp"]
    rows = [row for row in rows if "train_env_steps_per_second" in row]
    rows.sort(key=lambda row: (row["task"] != "reach", row["task"], row["substeps"], row["num_envs"]))
    return markdown(
        ["task, physics steps per action", "environments", "raw", "raw / engine's own", "training", "training / raw"],
        [
            [
                f"{row['task']}, {row['substeps']} × {40 // row['substeps']} ms",
                count(row["num_envs"]),
                rate(row["raw_env_steps_per_second"]),
                fixed(row["raw_to_bare"], 3),
                rate(row["train_env_steps_per_second"]),
                fixed(row["train_to_raw"], 3),
            ]
            for row in rows
        ],
    )


def engines(table: str) -> str:
    """How fast an older and a newer version of the engine step the same tasks on a GPU: a table of `bench/`."""
    rows = read_json(f"bench/{table}")["rows"]
    older, newer = dict.fromkeys((row["mujoco"], row["warp"]) for row in rows)
    cells = []
    for old in (row for row in rows if row["mujoco"] == older[0]):
        same = {name: old[name] for name in ("task", "num_envs", "substeps")} | {"mujoco": newer[0]}
        silent, warning = (pick(rows, **same, nativeccd=False, warnings=warnings) for warnings in (False, True))
        with_ccd = [row for row in rows if row["nativeccd"] and all(row[name] == same[name] for name in same)]
        cells.append(
            [
                f"{old['task']}, {old['substeps']}",
                count(old["num_envs"]),
                rate(old["env_steps_per_second"]),
                *(_beside(row, old) for row in (silent, warning)),
                rate(with_ccd[0]["env_steps_per_second"]) if with_ccd else "",
            ]
        )
    names = [f"MuJoCo {mujoco}, warp-lang {warp}" for mujoco, warp in (older, newer)]
    header = [names[0], f"{names[1]}, silent", f"{newer[0]} as it comes", f"{newer[0]} as it comes, with nativeccd"]
    return markdown(["task, physics steps per action", "environments", *header], cells)


def _beside(row: Row, other: Row) -> str:
    """Says the speed of a row, and as a ratio to another row's."""
    speed = row["env_steps_per_second"]
    return f"{rate(speed)} ({fixed(speed / other['env_steps_per_second'], 2)})"


def engine_options() -> str:
    """How fast MuJoCo Warp is with other settings, in how many kernels, and how far off the gripper then ends."""
    rows = [row for row in read_json("bench/bench")["rows"] if row["section"] == "engine-options"]
    tasks, cells = ("reach", "grasp"), []
    for name in dict.fromkeys(row["what"] for row in rows):
        of_tasks = [pick(rows, task=task, what=name) for task in tasks]
        rates = [rate(row["bare_warp_env_steps_per_second"]) for row in of_tasks]
        kernels = [str(row["kernels_per_substep"]) for row in of_tasks]
        off = [f"{1e3 * row['gripper_off_median']:.2f} ({1e3 * row['gripper_off_worst']:.1f}) mm" for row in of_tasks]
        cells.append([name, *rates, *kernels, *off])
    off_header = [f"gripper off on {task}, median (worst)" for task in tasks]
    return markdown(["setting", "steps/s, reach", "grasp", "kernels, reach", "grasp", *off_header], cells)


def several_gpus() -> str:
    """Training of reach on two and four H200s."""
    rows = [row for row in read_json("bench/bench")["rows"] if row["section"] == "devices"]
    header = ["training of reach", "GPUs", "one GPU with all", "all GPUs", "speed-up, weak", "speed-up, strong"]
    return markdown(header, [_on_gpus(row, rows) for row in rows if row["devices"] > 1])


def _on_gpus(row: Row, rows: list[Row]) -> list[str]:
    same: dict[str, Any] = {name: row[name] for name in ("seeds", "num_envs_per_seed")}
    seeds = "one seed" if row["seeds"] == 1 else f"{row['seeds']} seeds"
    return [
        f"{seeds} of {count(row['num_envs_per_seed'])} environments",
        str(row["devices"]),
        rate(pick(rows, **same, devices=1)["train_env_steps_per_second"]),
        rate(row["train_env_steps_per_second"]),
        fixed(row["weak_speed_up"], 2),
        fixed(row["strong_speed_up"], 2),
    ]


def on_a_cpu() -> str:
    """Env steps per second on two CPU cores: C MuJoCo in the program, its bare loop, and MJX-JAX."""
    rows = [
        row for row in read_json("bench/bench")["rows"] if row["section"] == "speed" and row["impl"] in ("c", "jax")
    ]
    rows = [row for row in rows if row["made_by"]["device"]["platform"] == "cpu"]
    return markdown(
        [
            "task",
            "engine",
            "environments",
            "physics steps",
            "raw",
            "its bare loop",
            "ratio",
            "training",
            "training / raw",
        ],
        [
            [
                row["task"],
                {"c": "C MuJoCo", "jax": "MJX-JAX"}[row["impl"]],
                count(row["num_envs"]),
                str(row["substeps"]),
                rate(row["raw_env_steps_per_second"]),
                rate(row.get("bare_rollout_env_steps_per_second", row.get("bare_mjx_env_steps_per_second"))),
                fixed(row["raw_to_bare"], 2),
                rate(row["train_env_steps_per_second"]),
                fixed(row["train_to_raw"], 2),
            ]
            for row in rows
        ],
    )


def peers() -> str:
    """How fast others step, on the same two CPU cores and on an H200."""
    rows = [row for row in read_json("bench/bench")["rows"] if row["section"] == "peers" and "success" not in row]
    return markdown(
        ["what", "where", "environments", "physics steps", "env steps per second"],
        [
            [
                f"{row['what']}, {row['task']}",
                f"{row['cpu_cores']} CPU cores" if "cpu_cores" in row else "one H200",
                count(row["num_envs"]) if "num_envs" in row else "",
                str(row["substeps"]),
                rate(row["env_steps_per_second"]),
            ]
            for row in rows
        ],
    )


def learners(task: str, platform: str, wanted: float = 0.98) -> str:
    """When the seeds of a learner first had a success rate in a test of the training: their median and the last."""
    rows = [row for row in read_json("bench/bench")["rows"] if row["section"] == "learners" and row["task"] == task]
    rows = [row for row in rows if row["made_by"]["device"]["platform"] == platform]
    lines = []
    for what in dict.fromkeys(row["what"] for row in rows):
        seeds = [row for row in rows if row["what"] == what]
        line = [what, str(len(seeds))]
        for column, write in (("env_steps", count), ("train_seconds", seconds)):
            found = sorted(_first(row, column, wanted) for row in seeds)
            most = f"not in {write(max(row[column][-1] for row in seeds))}"
            line += [write(value) if value < math.inf else most for value in (statistics.median(found), found[-1])]
        lines.append([*line, fixed(min(max(row["success"]) for row in seeds), 2)])
    header = ["learner", "seeds", "env steps, median", "last seed", "seconds, median", "last seed"]
    return markdown([*header, "the worst seed's best test"], lines)


def _first(row: Row, column: str, wanted: float) -> float:
    """Returns a row's entry at its first test with a success rate, infinity where there is none."""
    return next((value for value, rate in zip(row[column], row["success"], strict=True) if rate >= wanted), math.inf)


def paper_sizes(least: float = 0.1) -> str:
    """What one change to the paper's sizes comes to on reach; those that come to less than `least` share a row."""
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
    """What a second change to the paper's sizes comes to on reach, beside phases 1 + 3."""
    rows = [row for row in trials("paper-sizes-reach") if row["panel"] == "phases 1 + 3"]
    cells = [
        [row["setting"].replace("as they are", "none"), count(row["env_steps_per_seed"]), _with_seeds(row)]
        for row in rows
    ]
    return markdown(["second change", "env steps per seed", "success (of each seed)"], cells)


def _with_seeds(row: Row) -> str:
    return f"{fixed(row['success_rate'], 2)} ({', '.join(fixed(each, 2) for each in row['final']['success'])})"


def grasp_sizes() -> str:
    """What smaller trainings of grasp come to on the seeds for choosing, in the mean and in the worst."""
    rows = trials("grasp-sizes-grasp")
    weights = list(dict.fromkeys(row["setting"] for row in rows))
    cells = []
    for panel in dict.fromkeys(row["panel"] for row in rows):
        of_panel = [pick(rows, panel=panel, setting=weight) for weight in weights]
        ends = [f"{fixed(row['success_rate'], 3)} ({fixed(row['worst_seed'], 3)})" for row in of_panel]
        cells.append([panel, *ends, count(of_panel[0]["env_steps_per_seed"]), of_panel[0]["commit"]])
    return markdown(["sizes", *weights, "env steps per seed", "commit"], cells)


def smaller_trainings() -> str:
    """What smaller trainings of grasp on a GPU came to, each run of each."""
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


def robots() -> str:
    """Table 4 where the simulator tells the goal: policies run unchanged on other robots."""
    rows = [
        row for row in read_json("transfer/table4")["rows"] if row["stage"] == "exact goal" and row["policy"] == "plain"
    ]
    header = ["robot", "task", "hand at the start, action", "plain policies", "robust policy", "L1 distance"]
    return markdown(
        header,
        [
            [
                *_situation(row),
                _with_interval(row),
                _with_interval(_counterpart(row, policy="robust")),
                f"{fixed(row['distance_l1'], 3)} m",
            ]
            for row in rows
        ],
    )


def camera_goals() -> str:
    """Table 4 where cameras tell the goal, beside the same rows with the simulator's."""
    rows = [row for row in read_json("transfer/table4")["rows"] if row["stage"] == "camera goal"]
    stages = ["exact goal", "camera goal", "noisy-cameras goal", "one-camera goal", "one-noisy-camera goal"]
    header = ["robot", "task", "hand at the start, action", "policies", "exact", "two cameras", "two with noise"]
    return markdown(
        [*header, "one", "one with noise"],
        [
            [
                *_situation(row),
                row["policy"],
                *(fixed(_counterpart(row, stage=stage)["success_rate"], 3) for stage in stages),
            ]
            for row in rows
        ],
    )


def _situation(row: Row) -> list[str]:
    robot = row["robot"].removesuffix(" on C MuJoCo").removesuffix(", C MuJoCo")
    return [robot, row["task"], f"{row['hand_at_start']}, {row['milliseconds_per_action']:.0f} ms"]


def _with_interval(row: Row) -> str:
    return f"{fixed(row['success_rate'], 3)} ({fixed(row['success_low'], 2)} to {fixed(row['success_high'], 2)})"


def _counterpart(row: Row, **other: str) -> Row:
    """Returns the row of table 4 that differs from one in these columns alone."""
    columns = ("robot", "task", "hand_at_start", "milliseconds_per_action", "stage", "policy")
    return pick(read_json("transfer/table4")["rows"], **{name: row[name] for name in columns} | other)


def localised() -> str:
    """Errors of the target's position with two cameras and no noise."""
    rows = [row for row in read_csv("localisation/evaluation/errors") if row["cameras"] == 2]
    return markdown(
        ["target, scenes", "detector", "median", "95 % below", "not found", "more than 5 cm off"],
        [
            [
                f"{'ball' if row['target'] == 'marker' else row['target']}, {row['scenes']}",
                "largest red patch" if row["detector"] == "colour" else row["detector"],
                *(f"{fixed(row[name], 1)} mm" for name in ("median_mm", "p95_mm")),
                fixed(row["not_found_rate"], 3),
                fixed(row["far_rate"], 3),
            ]
            for row in rows
        ],
    )


def headline() -> str:
    """The figures of the front page, unflattering ones among them."""
    reach, grasp = trial("table1-reach", "HGAIL"), trial("table1-grasp", "HGAIL")
    runs = {
        "push": "push-td3",
        "pick and place, no reward": "pick-and-place-td3-no-reward",
        "pick and place, a quarter of the reward the goal test": "pick-and-place-td3",
        "slide": "slide-hgail",
    }
    suite = {name: read_json(f"runs/{run}/summary")["success_rate"] for name, run in runs.items()}
    sizes = trial("ablations-reach", "the paper's sizes", "with pre-training")
    return markdown(
        ["what", "paper", "here"],
        [
            ["reach", reach["paper_success"], success(reach)],
            ["grasp, lifted", grasp["paper_success"], success(grasp)],
            *([name, "", of_seeds(each)] for name, each in suite.items()),
            ["reach with the paper's own sizes", reach["paper_success"], success(sizes)],
        ],
    )


def parity(table: str = "parity") -> str:
    """How far the gripper goes another way than the reference's, on a CPU: a table of `parity/`."""
    engines = {"c": "C MuJoCo", "jax": "MJX-JAX"}
    return markdown(
        ["task", "reference", "engine", "physics steps", "one action, median (99 %)", "50 actions, median", "worst"],
        [
            [
                row["task"],
                row["reference"],
                engines[row["impl"]],
                str(row["substeps"]),
                f"{fixed(row['one_step_median_mm'], 2)} mm ({fixed(row['one_step_p99_mm'], 2)})",
                f"{fixed(row['drift_median_mm'], 1)} mm",
                f"{fixed(row['drift_worst_mm'], 0)} mm",
            ]
            for row in read_json(f"parity/{table}")["rows"]
        ],
    )

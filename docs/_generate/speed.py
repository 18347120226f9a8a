"""Writes the tables about speed, as Markdown."""

import math
import statistics
from typing import Any

from docs._generate.results import ROOT, Row, bench, bench_rows, count, fixed, pick, rate, read_json, seconds, start
from docs._generate.tables import markdown


def time_to_success() -> str:
    """Time that eight seeds take on one H200."""
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
    """Start of a run with empty and filled caches, on two hosts."""
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
    rows = [row for row in bench_rows("speed") if row["impl"] == "warp" and "train_env_steps_per_second" in row]
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
    """Env steps per second of an older and a newer version of the engine on a GPU: a table of `bench/`."""
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
    """Speed of a row, and its ratio to another row's."""
    speed = row["env_steps_per_second"]
    return f"{rate(speed)} ({fixed(speed / other['env_steps_per_second'], 2)})"


def engine_options() -> str:
    """Speed, kernels and error of the gripper of MuJoCo Warp under other settings."""
    rows = bench_rows("engine-options")
    tasks, cells = ("reach", "grasp"), []
    for name in dict.fromkeys(row["what"] for row in rows):
        of_tasks = [pick(rows, task=task, what=name) for task in tasks]
        rates = [rate(row["bare_warp_env_steps_per_second"]) for row in of_tasks]
        kernels = [str(row["kernels_per_substep"]) for row in of_tasks]
        off = [f"{1e3 * row['gripper_off_median']:.2f} ({1e3 * row['gripper_off_worst']:.1f}) mm" for row in of_tasks]
        cells.append([name, *rates, *kernels, *off])
    off_header = [f"gripper off on {task}, median (worst)" for task in tasks]
    return markdown(["setting", "steps/s, reach", "grasp", "kernels, reach", "grasp", *off_header], cells)


def several_gpus(task: str) -> str:
    """Training speed of a task on several GPUs."""
    rows = [row for row in bench_rows("devices") if row["task"] == task]
    header = [f"training of {task}", "GPUs", "one GPU with all", "all GPUs", "speed-up, weak", "speed-up, strong"]
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
    rows = [row for row in bench_rows("speed") if row["impl"] in ("c", "jax") and row["platform"] == "cpu"]
    header = ["task", "engine", "environments", "physics steps", "raw", "its bare loop", "ratio", "training"]
    return markdown(
        [*header, "training / raw"],
        [
            [
                row["task"],
                {"c": "C MuJoCo", "jax": "MJX-JAX"}[row["impl"]],
                count(row["num_envs"]),
                str(row["substeps"]),
                rate(row["raw_env_steps_per_second"]),
                rate(row.get("bare_rollout_env_steps_per_second") or row["bare_mjx_env_steps_per_second"]),
                fixed(row["raw_to_bare"], 2),
                rate(row["train_env_steps_per_second"]),
                fixed(row["train_to_raw"], 2),
            ]
            for row in rows
        ],
    )


def peers() -> str:
    """Env steps per second of other projects, on the same two CPU cores and on an H200."""
    rows = [row for row in bench_rows("peers") if "success" not in row]
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
    """Steps and seconds until a learner's seeds first had a success rate in an evaluation: median and last seed."""
    rows = [row for row in bench_rows("learners") if (row["task"], row["platform"]) == (task, platform)]
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


def other_trainers() -> str:
    """Environment steps and seconds until trainers of others had .98 on reach, on two CPU cores, and lines of glue."""
    ours = read_json("bench/trainers")["rows"]
    wanted = {"what": "JaxGCRL CRL", "task": "reach", "platform": "cpu"}
    crl = [row for row in bench_rows("learners") if wanted.items() <= row.items()]
    steps, time = (statistics.median(_first(row, what, 0.98) for row in crl) for what in ("env_steps", "train_seconds"))
    bench_row = Row(what=f"JaxGCRL's CRL, median of {len(crl)} seeds", task="reach", steps=steps, seconds=time)
    lines = [
        [row["what"], row["task"], count(row["steps"]), seconds(row["seconds"]), str(_lines(row["glue"]))]
        for row in [*ours, bench_row | {"glue": "experiments/bench/contrastive.py"}]
    ]
    return markdown(["trainer", "task", "env steps to .98", "seconds", "lines of glue"], lines)


def _lines(path: str) -> int:
    """Returns the lines of a file that are not empty."""
    return sum(bool(line.strip()) for line in (ROOT / path).read_text().splitlines())


def _first(row: Row, column: str, wanted: float) -> float:
    """Returns a row's entry at its first evaluation with a success rate, infinity if it never had it."""
    return next((value for value, rate in zip(row[column], row["success"], strict=True) if rate >= wanted), math.inf)

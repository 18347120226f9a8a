"""Writes the tables about robust policies, as Markdown."""

import dataclasses
import re
from collections.abc import Iterable

import numpy as np

from docs._generate.results import RESULTS, Row, count, fixed, read_json, seconds
from docs._generate.tables import markdown
from hgail_envs.randomization import LEVELS, Randomization

_KINDS = ("-robust", "-other-arms", "-known-delay")
_ENDS = f"({'|'.join(_KINDS)})$"


def levels() -> str:
    """Sizes of the named randomisation levels, without those that only show the policy more."""
    named = {
        name: level for name, level in LEVELS.items() if not (level.history or level.known_delay) and name != "none"
    }
    units = {"delay": "steps", "z_bias": "of a displacement", "hand_opening": "of the widest", "ramp": "of the rounds"}
    rows = []
    for field in dataclasses.fields(Randomization):
        values = [getattr(level, field.name) for level in named.values()]
        unit = units.get(field.name, "times" if isinstance(values[0], tuple) else "m")
        texts = ["–" if value == field.default else _range(np.atleast_1d(value)) for value in values]
        if field.name not in ("history", "known_delay"):
            rows.append([f"`{field.name}`", unit, *texts])
    return markdown(["size", "unit", *named], rows)


def robust() -> str:
    """Success of randomised trainings on the Fetch, under their level and nominal."""
    header = ["task", "learner", "level", "success under it", "undisturbed", "worst seed, undisturbed"]
    rows = []
    for folder in sorted(folder for kind in _KINDS for folder in (RESULTS / "runs").glob(f"*{kind}")):
        row, plain = (read_json(f"runs/{name}/summary") for name in (folder.name, re.sub(_ENDS, "", folder.name)))
        nominal = row["nominal_success_rate"]
        rates = [row["success_rate"]["mean"], nominal["mean"], min(nominal["per_seed"]), plain["success_rate"]["mean"]]
        level = read_json(f"runs/{folder.name}/config")["options"]["randomize"]
        steps, time = count(row["env_steps_per_seed"]), seconds(row["wall_seconds"]["total"])
        learner = "TD3" if row.get("learner") == "td3" else "PPO"
        rows.append([row["task"], learner, f"`{level}`", *(fixed(rate, 3) for rate in rates), steps, time])
    return markdown([*header, "plain policies, undisturbed", "env steps", "start to end"], rows)


def levels_elsewhere(task: str) -> str:
    """Success of TD3's eight seeds on hands whose gap is stretched, by the level of their training: mean and worst."""
    return _elsewhere(read_json("suite/off-policy")["levels_elsewhere"]["rows"], task)


def sizes_elsewhere(task: str, trials: str = "other-hands") -> str:
    """Success of TD3's eight seeds on hands whose gap is as it is, by the sizes of their training: mean and worst."""
    return _elsewhere(read_json(f"suite/{trials}")["rows"], task)


def _elsewhere(rows: Iterable[Row], task: str) -> str:
    rows = [row for row in rows if row["task"] == task]
    names = list(dict.fromkeys(name for row in rows for rates in row["seeds"].values() for name in rates))
    return markdown(
        ["trained under", *(name.replace(" x ", " × ") for name in names)],
        [[_level(row), *(_mean_and_worst(row["seeds"].values(), name) for name in names)] for row in rows],
    )


def _level(row: Row) -> str:
    """Returns the level of a row, and what was different in its training."""
    return f"`{row['level']}`" + (f", {row['variant']}" if "variant" in row else "")


def _mean_and_worst(seeds: Iterable[Row], name: str) -> str:
    rates = [rates[name] for rates in seeds if name in rates]
    return f"{fixed(np.mean(rates), 2)} ({fixed(min(rates), 2)})" if rates else "–"


def robust_causes() -> str:
    """Success on other robots of trainings by TD3 with and without parts of the disturbances."""
    rows = read_json("suite/off-policy")["robust_causes"]["rows"]
    names = [name for name in rows[0] if name not in ("setting", "env_steps", "undisturbed")]
    return markdown(
        ["trained with", "env steps", "undisturbed", *(name.replace(" x ", " × ") for name in names)],
        [
            [row["setting"], count(row["env_steps"]), *(fixed(row[name], 2) for name in ("undisturbed", *names))]
            for row in rows
        ],
    )


_ON_THE_UR5E = ["UR5e, 160 ms", "40 ms", "160 ms, closed at first"]


def robust_tuning() -> str:
    """Trials by which the randomisation sizes of grasp were chosen."""
    return markdown(
        ["rounds", "ramp", "width of the cube", "under these sizes", "undisturbed", *_ON_THE_UR5E],
        [
            [str(row["rounds"]), f"{row['ramp']:g}", _range(row["object_size"]), *_successes(row)]
            for row in read_json("suite/grasp")["robust_tuning"]["rows"]
        ],
    )


def robust_noise() -> str:
    """Success of grasp with two sizes of the sensors' errors, given by `goal_offset`."""
    return markdown(
        ["seed", "`goal_offset`", "under these sizes", "undisturbed", *_ON_THE_UR5E],
        [
            [str(row["seed"]), f"{row['offset']:g} m", *_successes(row)]
            for row in read_json("suite/grasp")["robust_tuning"]["noise"]["rows"]
        ],
    )


def robust_seeds(task: str) -> str:
    """Success of a robust policy's seeds on a UR5e, of which one is shipped."""
    rows = read_json(f"suite/{task}")["robust_seeds"]["seeds"]
    names = {"success_rate": "under `full`", "undisturbed": "undisturbed", "closed": "160 ms", "fast": "40 ms, open"}
    names |= {"open": "160 ms, open", "short": "160 ms, steps × 0.6", "long": "160 ms, steps × 1.4"}
    columns = [name for name in names if name in rows[0]]
    return markdown(
        ["seed", *(names[name] for name in columns)],
        [[str(row["seed"]), *(fixed(row[name], 3) for name in columns)] for row in rows],
    )


def _successes(row: Row) -> list[str]:
    names = ("success_rate", "undisturbed", "ur5e", "ur5e_fast", "ur5e_closed")
    return ["" if row[name] is None else fixed(row[name], 3) for name in names]


def _range(limits: Iterable[float]) -> str:
    """Formats a range.

    >>> _range([0.5, 1.5])
    '0.5 to 1.5'
    """
    return " to ".join(f"{number:g}" for number in limits)

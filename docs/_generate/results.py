"""Reads measured figures from `experiments/results`, and formats them for the documentation."""

import csv
import functools
import json
import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from experiments.paper.markdown import plus_minus
from hgail_jax.trainer.statistics import confidence_interval

ROOT = Path(__file__).parent.parent.parent
RESULTS = ROOT / "experiments" / "results"

Row = dict[str, Any]


@functools.cache
def read_json(name: str) -> Any:
    """Returns the content of a JSON file, e.g. `"runs/grasp-hgail/summary"`."""
    return json.loads((RESULTS / f"{name}.json").read_text())


@functools.cache
def read_csv(name: str) -> tuple[Row, ...]:
    """Returns the rows of a CSV file, e.g. `"runs/reach-hgail/metrics"`, numbers parsed."""
    with (RESULTS / f"{name}.csv").open(newline="") as file:
        return tuple({key: _parse(value) for key, value in row.items()} for row in csv.DictReader(file))


def _parse(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text


def pick(rows: Iterable[Row], **wanted: Any) -> Row:
    """Returns the one row that has these values.

    Raises:
      ValueError: no row has them, or several have.

    >>> pick([{"a": 1, "b": 2}, {"a": 3, "b": 4}], a=3)
    {'a': 3, 'b': 4}

    """
    found = [row for row in rows if all(row.get(key) == value for key, value in wanted.items())]
    if len(found) != 1:
        raise ValueError(f"{len(found)} rows have {wanted}; there must be one")
    return found[0]


def trials(study: str) -> list[Row]:
    """Returns the settings of a study of `paper/`, e.g. `"table1-reach"`, the paper's decimals with leading zeros."""
    return [
        row
        | {name: with_leading_zeros(row[name]) for name in ("paper_success", "paper_distance_l1")}
        | {"commit": row["made_by"]["commit"]}
        for row in read_json(f"paper/{study}")["settings"]
    ]


def trial(study: str, setting: str, panel: str | None = None) -> Row:
    """Returns a setting of a study of `paper/`, e.g. `trial("table1-reach", "HGAIL")`."""
    return pick(trials(study), setting=setting, **({} if panel is None else {"panel": panel}))


def curve(study: str, steps: int, setting: str, panel: str = "") -> list[float]:
    """Returns the success of each seed after `steps` steps, from a study of `paper/` that has a figure."""
    curves = trial(study, setting, panel)["curves"]
    return curves["success"][curves["env_steps"].index(steps)]


def halfway(study: str, setting: str) -> str:
    """Mean success after 307,200 steps without pre-training, a third of the way."""
    return fixed(mean(curve(study, 307_200, setting, "without pre-training")), 2)


def reached(study: str, setting: str, panel: str | None = None) -> str:
    """Success rate of a setting."""
    return fixed(trial(study, setting, panel)["success_rate"], 3)


def off(study: str, setting: str, panel: str | None = None) -> str:
    """L1 distance of a setting, in centimetres."""
    return f"{fixed(100.0 * trial(study, setting, panel)['distance_l1'], 1)} cm"


def hidden(target: str, cameras: int) -> str:
    """Fraction of plain scenes in which no camera sees the target."""
    rows = read_csv("localisation/evaluation/errors")
    return percent(pick(rows, target=target, scenes="plain", cameras=cameras, detector="network")["hidden_rate"])


def noisy(kind: str, value: float) -> str:
    """Median error of the cube's position under noise."""
    rows = read_csv("localisation/evaluation/noise")
    return f"{fixed(pick(rows, target='cube', detector='network', noise=kind, value=value)['median_mm'], 0)} mm"


def peak(study: str, setting: str, panel: str = "") -> str:
    """Highest mean success of a setting in any round."""
    return fixed(max(map(mean, trial(study, setting, panel)["curves"]["success"])), 2)


def bench(**wanted: Any) -> Row:
    """Returns the row of the benchmarks that has these values, see `bench_rows`."""
    return pick(bench_rows(), **wanted)


def bench_rows(section: str | None = None) -> list[Row]:
    """Returns the benchmarks' rows, of one section if named, with the `platform` and `commit` that made them."""
    made = [(row, row["made_by"]) for row in read_json("bench/bench")["rows"] if section in (None, row["section"])]
    return [row | {"platform": by["device"]["platform"], "commit": by.get("commit")} for row, by in made]


def transfer(
    robot: str, task: str, stage: str = "exact goal", hand: str = "closed", period: int = 40, policy: str = "plain"
) -> Row:
    """Returns a row of table 4; `robot` is the beginning of its name."""
    rows = [row for row in read_json("transfer/table4")["rows"] if row["robot"].startswith(robot)]
    rows = [row for row in rows if row["policy"] == policy]
    return pick(rows, task=task, stage=stage, hand_at_start=hand, milliseconds_per_action=period)


def rate_elsewhere(level: str, condition: str, task: str = "grasp", variant: str | None = None) -> Row:
    """Returns `mean` and `worst` of the success of a task's seeds on hands whose gap is stretched, by their level."""
    return _rate_elsewhere(read_json("suite/off-policy")["levels_elsewhere"]["rows"], level, condition, task, variant)


def rate_on_own_gap(level: str, condition: str, task: str = "grasp", variant: str | None = None) -> Row:
    """Returns `mean` and `worst` of the success of a task's seeds on hands whose gap is as it is, by their level."""
    return _rate_elsewhere(read_json("suite/other-hands")["rows"], level, condition, task, variant)


def _rate_elsewhere(rows: list[Row], level: str, condition: str, task: str, variant: str | None) -> Row:
    seeds = pick([row for row in rows if row.get("variant") == variant], task=task, level=level)["seeds"]
    rates = [rates[condition] for rates in seeds.values()]
    return Row(mean=mean(rates), worst=min(rates))


def under_condition(task: str, policy: str, condition: str) -> Row:
    """Returns a row of withstood.json: policies on the UR5e under a condition, as `stride 0.6`."""
    return pick(read_json("transfer/withstood")["rows"], task=task, policy=policy, condition=condition)


def sweep_point(robot: str, task: str, quantity: str, value: float, policy: str = "plain") -> Row:
    """Returns a point of the sweep of randomised episodes; `robot` is the beginning of its name."""
    rows = [row for row in read_json("transfer/transfer-sweep")["rows"] if row["robot"].startswith(robot)]
    rows = [row for row in rows if row["policy"] == policy]
    return pick(rows, task=task, quantity=quantity, value=value)


def mean(values: list[float]) -> float:
    """Returns the mean.

    >>> mean([1.0, 2.0])
    1.5
    """
    return sum(values) / len(values)


def with_leading_zeros(text: str) -> str:
    """Adds the zero before a decimal point.

    >>> with_leading_zeros(".98 ± .02"), with_leading_zeros("0.95")
    ('0.98 ± 0.02', '0.95')
    """
    return re.sub(r"(?<!\d)\.(?=\d)", "0.", text)


def fixed(value: float, digits: int) -> str:
    """Rounds to `digits` decimals.

    >>> fixed(0.1234, 2), fixed(1.0, 3)
    ('0.12', '1.000')
    """
    return f"{value:.{digits}f}"


def success(row: Row) -> str:
    """Success rate with the interval of its mean, if it has one.

    >>> success({"success_rate": 0.9, "success_ci95": 0.02})
    '0.900 ± 0.020'
    """
    return plus_minus(row["success_rate"], row.get("success_ci95"))


def rate(value: float) -> str:
    """Formats a rate, or another large number, to three digits.

    >>> rate(368_468.0), rate(12_254_835.4), rate(1304.3)
    ('368 k', '12.3 M', '1.30 k')
    """
    factor, suffix = next((pair for pair in ((1e6, " M"), (1e3, " k"), (1.0, "")) if value >= pair[0]), (1.0, ""))
    value /= factor
    return fixed(value, 0 if value >= 99.95 else 1 if value >= 9.995 else 2) + suffix


def count(value: float) -> str:
    """Formats a whole number with commas.

    >>> count(10291200.0)
    '10,291,200'
    """
    return f"{round(value):,}"


def seconds(value: float) -> str:
    """Formats a duration, with tenths below ten seconds.

    >>> seconds(6.7975), seconds(178.2), seconds(40.57)
    ('6.8 s', '178 s', '41 s')
    """
    return f"{fixed(value, 1 if value < 9.95 else 0)} s"


def percent(fraction: float, digits: int = 0) -> str:
    """Formats a fraction in per cent.

    >>> percent(0.094), percent(0.00263, 1)
    ('9 %', '0.3 %')
    """
    return f"{fixed(100.0 * fraction, digits)} %"


def start(state: str) -> Row:
    """Returns the summary of a run of reach whose start was timed, by its caches, e.g. `"other-host-cached"`."""
    return read_json("runs/starts")[f"reach-hgail-{state}"]


def run_means(run: str) -> list[float]:
    """Returns the mean success rate over the seeds in each evaluation of a run's training."""
    tests: dict[float, list[float]] = {}
    for row in read_csv(f"runs/{run}/metrics"):
        tests.setdefault(row["round"], []).append(row["success_rate"])
    return [mean(rates) for rates in tests.values()]


def of_seeds(rate: Row) -> str:
    """Mean of a summary's rate and its 95 % interval, as `success` of a table's row."""
    half = float(confidence_interval(rate["per_seed"]))
    return plus_minus(rate["mean"], half if math.isfinite(half) else None)


def ended(run: str) -> str:
    """Mean success of a run's seeds and the time from its start to its end."""
    summary = read_json(f"runs/{run}/summary")
    return f"{fixed(summary['success_rate']['mean'], 3)} after {seconds(summary['wall_seconds']['total'])}"


def printed(run: str) -> str:
    """Returns the last lines that `hgail train` printed in a run of `runs/`, as a block of code."""
    summary = read_json(f"runs/{run}/summary")
    rates, spent = summary["success_rate"], {what: fixed(time, 1) for what, time in summary["wall_seconds"].items()}
    success_line = (
        f"success {of_seeds(rates)} (worst seed {fixed(min(rates['per_seed']), 3)}),"
        f" L1 distance {fixed(summary['distance_l1']['mean'], 3)} m,"
        f" {count(summary['env_steps_per_seed'])} env steps per seed"
    )
    seconds_line = (
        f"compile {spent['compile']} s, train {spent['train']} s at"
        f" {count(summary['env_steps_per_second'])} env steps/s, evaluate {spent['evaluation']} s,"
        f" total {spent['total']} s -> runs/{summary['task']}-{summary['method']}-1"
    )
    return f"\n\n```\n{success_line}\n{seconds_line}\n```\n\n"

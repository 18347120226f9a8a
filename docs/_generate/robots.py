"""Writes the tables about other robots, cameras and the reference, as Markdown."""

import itertools
from typing import Any

from docs._generate.results import Row, fixed, read_csv, read_json, sweep_point, transfer, under_condition
from docs._generate.tables import markdown

_ON_THE_FETCH = (
    ("grasp", "delay", 2, "two steps of delay"),
    ("pick-and-place", "delay", 2, "two steps of delay"),
    ("grasp", "noise", 0.02, "the goal off by 2 cm"),
    ("grasp", "gripper noise", 0.01, "the gripper seen off by 1 cm, anew at each step"),
    ("grasp", "posture", 0.12, "the start displaced by up to 12 cm along each axis"),
    ("pick-and-place", "finger speed", 0.25, "fingers four times slower"),
    ("pick-and-place", "object offset", 0.02, "the cube seen off by 2 cm"),
    ("pick-and-place", "object noise", 0.02, "the cube seen off by 2 cm, anew at each step"),
)
_ON_THE_UR5E = {
    "delay 3": "three steps of delay",
    "stride 0.6": "the shortest steps",
    "stride 1.4": "the longest steps",
    "noise 0.01": "the goal off by 1 cm",
}
_POLICIES = {
    "plain": "plain",
    "other arms": "under `other-arms`",
    "known delay": "told its delay",
    "robust": "robust",
}

_IN_TABLE_4: dict[str, dict[str, Any]] = {
    "UR5e 160 ms": {"robot": "UR5e", "hand": "closed", "period": 160},
    "UR5e 160 ms, open": {"robot": "UR5e", "hand": "open", "period": 160},
    "UR5e 40 ms, open": {"robot": "UR5e", "hand": "open", "period": 40},
    "Franka 160 ms": {"robot": "Franka", "hand": "closed", "period": 160},
    "Franka 160 ms, open": {"robot": "Franka", "hand": "open", "period": 160},
}
_DISTURBED = {"UR5e, steps × .6": "stride 0.6", "UR5e, off by 1 cm": "noise 0.01"}


def robots() -> str:
    """Table 4 with the simulator's goal: policies run unchanged on other robots."""
    exact = [row for row in read_json("transfer/table4")["rows"] if row["stage"] == "exact goal"]
    rates = {(*_situation(row), row["policy"]): _with_interval(row) for row in exact}
    others = ("other arms", "known delay", "robust", "script")
    header = ["robot", "task", "hand at the start, action", "plain policies"]
    return markdown(
        [*header, "under `other-arms`", "told its delay", "robust policy", "script"],
        [
            [*_situation(row), _with_interval(row), *(rates.get((*_situation(row), name), "–") for name in others)]
            for row in exact
            if row["policy"] == "plain"
        ],
    )


def camera_goals() -> str:
    """Table 4 with the goal from cameras, beside the same rows with the simulator's."""
    rows = [row for row in read_json("transfer/table4")["rows"] if row["stage"] == "noisy-cameras goal"]
    stages = ["exact goal", "camera goal", "noisy-cameras goal", "one-camera goal", "one-noisy-camera goal"]
    header = ["robot", "task", "hand at the start, action", "policies", "exact", "two cameras", "two with noise"]
    return markdown(
        [*header, "one", "one with noise"],
        [
            [
                *_situation(row),
                _POLICIES.get(row["policy"], row["policy"]),
                *(_rate_of(row, stage) for stage in stages),
            ]
            for row in rows
        ],
    )


def _situation(row: Row) -> list[str]:
    robot = row["robot"].removesuffix(" on C MuJoCo").removesuffix(", C MuJoCo")
    return [robot, row["task"], f"{row['hand_at_start']}, {row['milliseconds_per_action']:.0f} ms"]


def _with_interval(row: Row) -> str:
    return f"{fixed(row['success_rate'], 3)} ({fixed(row['success_low'], 2)} to {fixed(row['success_high'], 2)})"


def _rate_of(row: Row, stage: str) -> str:
    """Returns the success in the row of table 4 that differs from one in its stage alone, if there is one."""
    columns = ("robot", "task", "hand_at_start", "milliseconds_per_action", "policy")
    wanted = {name: row[name] for name in columns} | {"stage": stage}
    rates = [each["success_rate"] for each in read_json("transfer/table4")["rows"] if wanted.items() <= each.items()]
    return fixed(rates[0], 3) if rates else "–"


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


def parity(table: str = "parity") -> str:
    """Distance of the gripper from the reference's, on a CPU: a table of `parity/`."""
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


def withstood() -> str:
    """Success of policies with one quantity randomised, on this package's Fetch and on the UR5e."""
    rows = []
    for task, quantity, value, words in _ON_THE_FETCH:
        found = [sweep_point("This", task, quantity, value, policy) for policy in _POLICIES]
        rows.append(["this package's Fetch", task, words, *(fixed(row["success_rate"], 2) for row in found), "–"])
    measured = {(row["task"], row["policy"], row["condition"]) for row in read_json("transfer/withstood")["rows"]}
    for task, (condition, words) in itertools.product(("grasp", "pick-and-place"), _ON_THE_UR5E.items()):
        points = [(task, policy, condition) for policy in (*_POLICIES, "script")]
        rates = [fixed(under_condition(*each)["success_rate"], 2) if each in measured else "–" for each in points]
        rows.append(["UR5e", task, words, *rates])
    return markdown(["robot", "task", "disturbance", *_POLICIES.values(), "script"], rows)


def gaps_compared() -> str:
    """Success of policies on hands whose gap was stretched to the Fetch's, and on those that show their own."""
    rows = read_json("suite/other-hands")["stretched"]["rows"]
    names = [*_IN_TABLE_4, *_DISTURBED]
    policies = _POLICIES | {"sensors": "under `sensors`"}
    return markdown(
        ["task", "policies", *names],
        [[row["task"], policies[row["policy"]], *(_stretched_and_own(row, name) for name in names)] for row in rows],
    )


def _stretched_and_own(row: Row, name: str) -> str:
    """Returns the success of a policy with the stretched gap and with the hand's own."""
    if name not in row["rates"]:
        return "–"
    task, policy = row["task"], row["policy"]
    if "own" in row:
        own = row["own"][name]
    elif name in _DISTURBED:
        own = under_condition(task, policy, _DISTURBED[name])["success_rate"]
    else:
        own = transfer(task=task, policy=policy, **_IN_TABLE_4[name])["success_rate"]
    return f"{fixed(row['rates'][name], 3)}, {fixed(own, 3)}"

"""Writes the tables about other robots, cameras and the reference, as Markdown."""

from docs._generate.results import Row, fixed, read_csv, read_json, sweep_point
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
_ON_THE_UR5E = (
    ("grasp", "delay", 2, "two steps of delay"),
    ("grasp", "stride", 0.6, "the shortest steps"),
    ("grasp", "stride", 1.4, "the longest steps"),
    ("grasp", "goal noise", 0.02, "the goal off by 2 cm, anew at each step"),
    ("grasp", "noise", 0.01, "the goal off by 1 cm"),
    ("grasp", "noise", 0.02, "the goal off by 2 cm"),
    ("grasp", "gripper noise", 0.01, "the gripper seen off by 1 cm, anew at each step"),
    ("pick-and-place", "delay", 2, "two steps of delay"),
    ("pick-and-place", "stride", 0.6, "the shortest steps"),
    ("pick-and-place", "gripper offset", 0.01, "the gripper seen off by 1 cm"),
)


def robots() -> str:
    """Table 4 with the simulator's goal: policies run unchanged on other robots."""
    exact = [row for row in read_json("transfer/table4")["rows"] if row["stage"] == "exact goal"]
    rates = {(*_situation(row), row["policy"]): _with_interval(row) for row in exact}
    others = ("sensors", "known delay", "robust", "script")
    header = ["robot", "task", "hand at the start, action", "plain policies"]
    return markdown(
        [*header, "under `sensors`", "told its delay", "robust policy", "script"],
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
                row["policy"],
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
    """Success of policies with one quantity randomised, on two robots."""
    rows = []
    for robot, name, points in (("This", "this package's Fetch", _ON_THE_FETCH), ("UR5e", "UR5e", _ON_THE_UR5E)):
        for task, quantity, value, words in points:
            policies = ("plain", "sensors", "known delay", "robust")
            found = [sweep_point(robot, task, quantity, value, policy) for policy in policies]
            episodes = sorted({row["episodes"] for row in found})
            rates = [fixed(row["success_rate"], 2) for row in found]
            rows.append([name, task, words, *rates, " to ".join(f"{number:.0f}" for number in episodes)])
    header = ["robot", "task", "disturbance", "plain", "under `sensors`", "told its delay", "robust", "episodes each"]
    return markdown(header, rows)

"""Writes the tables about policies under disturbances, as Markdown, from what was measured."""

from docs._generate.results import disturbed, fixed
from docs._generate.tables import markdown

_ON_THE_FETCH = (
    ("grasp", "delay", 2, "two steps of delay"),
    ("pick-and-place", "delay", 2, "two steps of delay"),
    ("grasp", "noise", 0.02, "the goal off by 2 cm"),
    ("grasp", "gripper noise", 0.01, "the gripper seen off by 1 cm, anew at each step"),
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
)


def withstood() -> str:
    """Success of the plain and the robust policies under single disturbances, on two robots."""
    rows = []
    for robot, name, points in (("This", "this package's Fetch", _ON_THE_FETCH), ("UR5e", "UR5e", _ON_THE_UR5E)):
        for task, quantity, value, words in points:
            plain, robust = (disturbed(robot, task, quantity, value, policy) for policy in ("plain", "robust"))
            shares = [fixed(row["success_rate"], 2) for row in (plain, robust)]
            rows.append([name, task, words, *shares, f"{plain['episodes']:.0f}"])
    return markdown(["robot", "task", "disturbance", "plain", "robust", "episodes"], rows)

"""The robots that policies are transferred to: a class each, and a line in `ROBOTS`."""

import functools
import inspect
from typing import Any

import numpy as np

from experiments.transfer.robots.base import Robot
from experiments.transfer.robots.servo_arm import Franka, UR5e
from hgail_envs.tasks import reference


class GymnasiumFetch(reference.ReferenceFetch, Robot):
    """Gymnasium-Robotics' Fetch, on C MuJoCo with its own meshes; see `hgail_envs.tasks.reference.ReferenceFetch`."""

    name = "Fetch, Gymnasium-Robotics on C MuJoCo"
    extra = "compare"
    packages = ("gymnasium-robotics",)
    tasks = reference.reference_tasks()
    unaffected_by = ("gravity",)  # the model compensates none

    offset = np.zeros(3)
    cube = "object0"


ROBOTS: dict[str, type[Robot]] = {
    "gymnasium": GymnasiumFetch,
    "ur5e": UR5e,
    "franka": Franka,
}
"""Robots' classes by their names on the command line."""


@functools.cache
def make_robot(name: str, task: str, **options: Any) -> Robot:
    """Makes a robot of `ROBOTS` for a task, e.g. `"reach"`; the same arguments return the same robot.

    Raises:
      ValueError: the robot lacks the task, an option, or an installed package.
    """
    if name not in ROBOTS:
        raise ValueError(f"policies go to {', '.join(ROBOTS)}, not to {name}: hgail evaluate --reference is for it")
    robot = ROBOTS[name]
    if task not in robot.tasks:
        raise ValueError(f"{name} cannot do {task!r}; it does {', '.join(robot.tasks)}")
    accepted = list(inspect.signature(robot).parameters)[1:]
    if "robot" in options and "robot" not in accepted:
        raise ValueError(f"policies of {options['robot']!r} do not go to {name}; those of the Fetch do")
    for option in options:
        if option not in accepted:
            others = ", ".join(each for each in accepted if each != "robot")  # which the policy's file sets
            raise ValueError(f"{name} has no option {option!r}; it has {others or 'none'}")
    try:
        return robot(task, **options)
    except ModuleNotFoundError as error:
        raise ValueError(f'{name} needs the package {error.name}; pip install -e ".[{robot.extra}]"') from error

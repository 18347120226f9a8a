"""Gymnasium-Robotics' Fetch, on C MuJoCo with the robot's own meshes."""

import numpy as np

from experiments.transfer.robots.base import Robot
from hgail_envs.fetch import reference


class GymnasiumFetch(reference.ReferenceFetch, Robot):
    """The reference environment of a task; see `hgail_envs.fetch.reference.ReferenceFetch`."""

    name = "Fetch, Gymnasium-Robotics on C MuJoCo"
    extra = "compare"
    packages = ("gymnasium-robotics",)
    tasks = reference.TASKS
    unaffected_by = ("gravity",)  # the model compensates none

    offset = np.zeros(3)
    cube = "object0"
    marker = "target0"

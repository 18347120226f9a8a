"""Robots: arms with a hand, each in a scene around it."""

import functools
from collections.abc import Callable

from hgail_envs.robots.base import Robot
from hgail_envs.robots.fetch import Fetch
from hgail_envs.robots.servo_arm import ServoArm
from hgail_envs.validation import check_name

_ARMS = ("franka", "ur5e")

ROBOTS: dict[str, Callable[..., Robot]] = {"fetch": Fetch} | {name: functools.partial(ServoArm, name) for name in _ARMS}
"""Robots by name; those of `assets/robots/<name>.toml` are arms with servos."""


def make_robot(name: str, scene: str, base_x: float, start_height: float) -> Robot:
    """Makes a robot of `ROBOTS` in a scene; see `Robot` for the arguments.

    A ValueError says that there is none of this name, or what it needs that is not installed.
    """
    check_name("robot", name, tuple(ROBOTS))
    return ROBOTS[name](scene, base_x, start_height)

"""Robots: arms with a hand, each in a scene around it."""

import functools
from collections.abc import Callable

from hgail_envs.robots.base import Robot
from hgail_envs.robots.description import is_file, read_description
from hgail_envs.robots.fetch import Fetch
from hgail_envs.robots.servo_arm import ServoArm
from hgail_envs.validation import check_name

_ARMS = ("franka", "ur5e", "so101")

ROBOTS: dict[str, Callable[..., Robot]] = {"fetch": Fetch} | {name: functools.partial(ServoArm, name) for name in _ARMS}
"""Robots by name; those of `assets/robots/<name>.toml` are arms with servos."""


def check_robot(name: str) -> None:
    """Raises a ValueError if a name is neither one of `ROBOTS` nor a description's file, `.toml`, that can be read."""
    if is_file(name):
        read_description(name)
    else:
        check_name("robot", name, (*ROBOTS, "FILE.toml, which hgail robot writes"))


def make_robot(name: str, scene: str, base_x: float, start_height: float) -> Robot:
    """Makes a robot of `ROBOTS`, or of a description's file, in a scene; see `Robot` for the arguments.

    A ValueError says that there is none of this name, or what it needs that is not installed.
    """
    check_robot(name)
    make = functools.partial(ServoArm, name) if is_file(name) else ROBOTS[name]
    return make(scene, base_x, start_height)

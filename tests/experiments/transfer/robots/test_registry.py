"""What the robots' packages and registry promise."""

import sys

import pytest

from experiments.transfer.robots import ROBOTS, make_robot
from experiments.transfer.tasks import TASKS


class NeedsMore:
    extra, tasks = "compare", ("reach",)

    def __init__(self, task):
        import no_such_module  # noqa: F401


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(ROBOTS, "new", NeedsMore)
    with pytest.raises(ValueError, match=r"new needs the package no_such_module; pip install -e .*compare"):
        make_robot("new", "reach")


def test_a_task_that_a_robot_cannot_do_is_refused():
    with pytest.raises(ValueError, match="ur5e cannot do 'push'; it does reach, grasp"):
        make_robot("ur5e", "push")


@pytest.mark.parametrize(
    ("robot", "package"), [("gymnasium", "gymnasium_robotics"), ("ur5e", "mink"), ("franka", "mink")]
)
def test_a_robot_is_listed_without_its_extra(robot, package, monkeypatch):
    """Only making it needs the extra, and says which."""
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "experiments.transfer.robots.inverse_kinematics", raising=False)
    extra = ROBOTS[robot].extra
    with pytest.raises(ValueError, match=rf"{robot} needs the package {package}; pip install -e .*{extra}"):
        make_robot.__wrapped__(robot, "reach")


@pytest.mark.parametrize("robot", list(ROBOTS))
def test_the_first_variant_is_the_default(robot):
    for task in TASKS:
        assert not ROBOTS[robot].variants(task)[0]

"""Interface of a robot that policies trained on the Fetch can drive."""

import abc
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import mujoco
import numpy as np

import hgail_envs


@dataclasses.dataclass(frozen=True)
class OptionCurve:
    """A curve of success against one of a robot's own options, such as its speed."""

    quantity: str
    """Name of the panel that the curve is drawn in."""
    axis: str
    """Label of the panel's x axis."""
    line: str
    """Label of this curve among the robot's others in the panel."""
    task: str
    """One of the robot's tasks."""
    option: str
    """Keyword argument of the robot's class that varies."""
    values: tuple[float, ...]
    """Values of that option."""
    fixed: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """The robot's other options."""


class Robot(abc.ABC):
    """A simulated robot in its scene, which can do the tasks `reach` and `grasp`, or more.

    Positions are metres in the policy's frame, which is the world frame of the Fetch scenes.

    Args:
      task: one of `tasks`; a robot's further arguments, its options, have defaults.
    """

    name: ClassVar[str]
    """Robot and hand, then a comma and the simulator; tables call it this, and legends the part before the comma."""
    extra: ClassVar[str]
    """Extra of this project, in `pyproject.toml`, that installs the robot's packages."""
    packages: ClassVar[tuple[str, ...]]
    """Distributions behind the extra; results record their versions."""
    tasks: ClassVar[tuple[str, ...]] = ("reach", "grasp")
    """Tasks of the robot, by their names in `hgail_envs.TASKS`."""
    curves: ClassVar[tuple[OptionCurve, ...]] = ()
    """Curves over the robot's own options, for the robustness figure."""
    unaffected_by: ClassVar[tuple[str, ...]] = ()
    """Names in `QUANTITIES` that do not affect the robot; it has no curves of them."""

    slowdown: int = 1
    """Duration of an action, times `CONTROL_PERIOD`."""
    starts_closed: bool = True
    """True if the hand is closed at the start of an episode."""

    task: str
    """One of `tasks`."""
    model: mujoco.MjModel
    """The scene."""
    data: mujoco.MjData
    """Its state."""
    offset: np.ndarray
    """`[3]`: origin of the scene's world frame in the policy's frame, added to positions."""
    cube: str
    """Name of the cube's geom, in a scene for `grasp`."""

    @abc.abstractmethod
    def __init__(self, task: str) -> None: ...

    @abc.abstractmethod
    def reset(self, rng: np.random.Generator) -> None:
        """Starts an episode: the robot at its start, and a random target."""

    @abc.abstractmethod
    def features(self) -> np.ndarray:
        """Returns the observation without the goal, in the Fetch's units.

        That is `[6]` as in `hgail_envs.tasks.reach.Reach`, `[8]` as in `hgail_envs.tasks.grasp.Grasp`, and so on.
        """

    @abc.abstractmethod
    def target(self) -> np.ndarray:
        """Returns the target's position, `[3]`: the point to reach, the cube's centre in grasp, the object's goal."""

    def carried(self) -> np.ndarray:
        """Returns the position, `[3]`, that is compared with the target; by default the gripper's."""
        return self.features()[:3]

    def reached(self) -> bool:
        """Returns whether that position is near enough to the target."""
        return bool(
            np.linalg.norm(self.carried() - self.target()) <= hgail_envs.find_class(self.task).success_threshold
        )

    @abc.abstractmethod
    def step(self, action: np.ndarray) -> None:
        """Carries out an action, `[4]`: a displacement of the gripper, and the hand's command, in [-1, 1].

        An episode with a longer stride has displacements up to 2, beyond any policy's.
        """

    @classmethod
    def variants(cls, task: str) -> Sequence[Mapping[str, Any]]:
        """Returns the options of the robot's rows for a task in the table with the exact goal.

        The first must be the defaults, `{}`.
        """
        del task
        return ({},)

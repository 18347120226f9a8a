"""The interface of robots: an arm with a hand in a scene, whose gripper an action moves."""

import abc

import jax
import mujoco
import numpy as np

from hgail_envs.engines import Control, Engine, EngineState
from hgail_envs.robots.kinematics import Chain, Pose
from hgail_envs.scenes import HAND, check_names, explained, without_visuals
from hgail_envs.variation import ModelFactors

CONTROL_PERIOD = 0.04
"""Seconds between two actions."""
REFERENCE_SUBSTEPS = 20
"""Physics steps per action in the reference: 20 of 2 ms."""
TOP_SPEED = 0.83
"""Metres per second of the gripper along an axis, by a unit of an action."""
BASE_X = 0.405
"""Position of the robot along x, metres, where a task has no other."""
START_HEIGHT = 0.2
"""Nominal height of the gripper's start above the table, metres, where a task has no other."""


class ArmPhysics(EngineState, kw_only=True):
    """State of the engine, and the gripper's pose and velocity that follow from it."""

    body_position: jax.Array
    """`[3]`: the gripper's body, metres."""
    body_quaternion: jax.Array
    """`[4]`: the same body's orientation."""
    gripper_position: jax.Array
    """`[3]`: the point between the fingers, metres, world frame."""
    gripper_velocity: jax.Array
    """`[3]`: its linear velocity times `CONTROL_PERIOD`, metres, as the reference has it."""
    factors: ModelFactors | None = None
    """Factors on the scene's model; None for the scene's own."""


class Robot(abc.ABC):
    """A robot in a scene, its hand pointing downward and closing along y.

    Its model has a site `grip`, the point between the pads and 18.5 mm above their ends, and the geoms `palm`,
    `right_pad` and `left_pad`, which the scene lets collide. A task knows no other name of it.

    Args:
      scene: a scene of the package by its name, or the path of an MJCF file, see `hgail_envs.scenes.find_scene`.
      base_x: position of the robot along x, metres.
      start_height: nominal height of the gripper's start above the table, metres.
    """

    lowest_height: float
    """Least height of the gripper, metres: the pads rest on the table, or are near enough for servos."""
    scale: float = 1.0
    """Metres of the scene to a metre of the robot."""
    name: str
    """Its name in `hgail_envs.robots.ROBOTS`."""

    def __init__(self, scene: str, base_x: float = BASE_X, start_height: float = START_HEIGHT) -> None:
        self.scene, self.base_x, self.start_height = scene, base_x, start_height
        self.model = self.load()
        check_names(self.model, scene, "site", "grip", "target")
        check_names(self.model, scene, "geom", *HAND)
        self._chain = Chain(self.model, "grip")  # since MJX-Warp exposes no velocities

    def load(self, visual: bool = False) -> mujoco.MjModel:
        """Compiles the scene with the robot in it; `visual` keeps geoms without an effect."""
        spec = self.spec()
        with explained(self.scene):
            return (spec if visual else without_visuals(spec)).compile()

    @abc.abstractmethod
    def spec(self) -> mujoco.MjSpec:
        """Returns the scene with the robot in it."""

    def reference_engine(self, slowdown: int = 1) -> Engine:
        """Returns an engine that carries out the controls on the robot's full model, in `slowdown` times the period.

        A ValueError says that it has none.
        """
        raise ValueError(f"robot {self.name!r} has no full model here; impl 'reference' is of arms with servos")

    @abc.abstractmethod
    def settle(self, offset: np.ndarray | float = 0.0) -> mujoco.MjData:
        """Brings the gripper to its start by C MuJoCo, displaced by `offset`, `[3]`, metres, and lets it settle."""

    def gripper(self, qpos: jax.Array, qvel: jax.Array) -> Pose:
        """Returns the gripper's pose and velocity for joint positions `[nq]` and velocities `[nv]`."""
        return self._chain.pose(qpos, qvel)

    @abc.abstractmethod
    def control(self, physics: ArmPhysics, displacement: jax.Array, grip: jax.Array | None) -> Control:
        """Returns the engine's control for an action.

        A unit of `displacement`, `[3]`, moves the gripper about 33 mm once it is up to speed. `grip`, `[]` in [-1, 1],
        opens or closes the hand; None in a scene in which it stays closed.
        """

    @abc.abstractmethod
    def keep_closed(self, qpos: jax.Array) -> jax.Array:
        """Returns joint positions, `[nq]`, after an action in a scene in which the hand stays closed."""

    @abc.abstractmethod
    def opened(self, qpos: jax.Array, gap: jax.Array) -> jax.Array:
        """Returns joint positions, `[nq]`, with the hand opened to a `gap`, `[]`, metres, if it opens at all."""

    @abc.abstractmethod
    def gap(self, qpos: jax.Array) -> jax.Array:
        """Returns the distance between the pads, `[]`, metres."""

    def narrowest_gap(self, qpos: jax.Array) -> jax.Array:
        """Returns the width of the room between the pads, `[]`, metres: less than the gap where they have turned."""
        return self.gap(qpos)

    @abc.abstractmethod
    def widest_gap(self, factors: ModelFactors | None = None) -> jax.Array | float:
        """Returns the widest distance between the pads, `[]`, metres; None is the scene's own model."""

    @abc.abstractmethod
    def fingers(self, physics: ArmPhysics) -> tuple[jax.Array, jax.Array]:
        """Returns how far the right and the left finger are open, metres, and how fast, metres per second: `[2]`."""

    @abc.abstractmethod
    def hand_fields(self, factors: ModelFactors, others: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """Returns the model's fields that differ for other pads and fingers, where `others` already differ."""

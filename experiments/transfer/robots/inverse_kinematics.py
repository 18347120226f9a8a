"""The joint motion of an arm whose tool points downward, by mink's differential inverse kinematics."""

from collections.abc import Sequence

import mink
import mujoco
import numpy as np

_SOLVER = "daqp"
_DAMPING = 1e-8
_ITERATIONS = 100  # after which `move_to` has arrived


class DownwardArm:
    """Joint positions of an arm, which its servos follow.

    Args:
      model: the arm alone.
      tool: name of the tool's site.
      orientation: `[3, 3]`, rotation of that site in the world frame when the tool points downward.
      top_speed: of each joint, radians per second.
      posture_cost: weight of the first joint positions beside the tool's position, for an arm of more than six joints.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        tool: str,
        orientation: np.ndarray,
        top_speed: Sequence[float],
        posture_cost: float = 0.0,
    ) -> None:
        self._configuration = mink.Configuration(model)
        self._task = mink.FrameTask(tool, "site", position_cost=1.0, orientation_cost=1.0)
        self._orientation = mink.SO3.from_matrix(orientation)
        self._posture = mink.PostureTask(model, posture_cost) if posture_cost else None
        speeds = {model.joint(index).name: speed for index, speed in enumerate(top_speed)}
        self._limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speeds)]

    @property
    def joints(self) -> np.ndarray:
        """The joint positions, `[joints]`, radians."""
        return self._configuration.q.copy()

    @joints.setter
    def joints(self, positions: np.ndarray) -> None:
        self._configuration.update(positions.copy())
        if self._posture is not None and self._posture.target_q is None:
            self._posture.set_target(positions)

    def approach(self, position: np.ndarray, time: float) -> np.ndarray:
        """Moves the joints to bring the tool as near to a position as possible in a time.

        Args:
          position: `[3]`, metres, in the frame of the arm's base.
          time: seconds.

        Returns:
          The joint velocities of that motion, `[joints]`, radians per second.
        """
        self._task.set_target(mink.SE3.from_rotation_and_translation(self._orientation, position))
        tasks = [self._task] if self._posture is None else [self._task, self._posture]
        velocities = mink.solve_ik(self._configuration, tasks, time, _SOLVER, damping=_DAMPING, limits=self._limits)
        self._configuration.integrate_inplace(velocities, time)
        return velocities

    def move_to(self, position: np.ndarray) -> None:
        """Sets the joints to bring the tool to a position, `[3]`, searching from the present ones."""
        for _ in range(_ITERATIONS):
            self.approach(position, time=1.0)

"""The joint motion of an arm whose tool points downward, by mink's differential inverse kinematics."""

import mink
import mujoco
import numpy as np

_DAMPING = 1e-8
_ITERATIONS = 100


class DownwardArm:
    """The joints of an arm, as a reference for its servos.

    Args:
      model: the arm alone.
      tool: name of the tool's site.
      orientation: `[3, 3]`, of the site in the world frame, when the tool points downward.
      fastest: radians a second, of each joint.

    """

    def __init__(self, model: mujoco.MjModel, tool: str, orientation: np.ndarray, fastest: float):
        self._configuration = mink.Configuration(model)
        self._task = mink.FrameTask(tool, "site", position_cost=1.0, orientation_cost=1.0)
        self._orientation = mink.SO3.from_matrix(orientation)
        speeds = {model.joint(index).name: fastest for index in range(model.njnt)}
        self._limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speeds)]

    @property
    def joints(self) -> np.ndarray:
        """The joints' positions, `[joints]`, radians."""
        return self._configuration.q.copy()

    @joints.setter
    def joints(self, positions: np.ndarray) -> None:
        self._configuration.update(positions.copy())

    def approach(self, position: np.ndarray, time: float) -> np.ndarray:
        """Moves the joints for some time; returns their velocities, `[joints]`, which bring the tool to `position`."""
        self._task.set_target(mink.SE3.from_rotation_and_translation(self._orientation, position))
        velocities = mink.solve_ik(
            self._configuration, [self._task], time, "daqp", damping=_DAMPING, limits=self._limits
        )
        self._configuration.integrate_inplace(velocities, time)
        return velocities

    def go(self, position: np.ndarray) -> None:
        """Puts the joints to where the tool is at `position`, from wherever they are."""
        for _ in range(_ITERATIONS):
            self.approach(position, time=1.0)

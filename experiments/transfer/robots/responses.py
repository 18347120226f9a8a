"""Responses of the Fetch's gripper and fingers to an action, which other robots track to move alike.

Both start each action near the robot's measured position, as the Fetch's weld and servos do. Times are the Fetch's, on
which an action lasts `CONTROL_PERIOD`.
"""

import numpy as np

from hgail_envs.robots.fetch import LEAD

# The weld of assets/robots/fetch.xml is critically damped. With its own 0.95 × 0.02 s steps would be 5 % too long,
# as the gripper drags the arm along; this constant fits the reference.
_TIME_CONSTANT = 0.0203  # seconds
_SLACK = 0.003  # metres, most distance between the gripper and its reference, which bounds its push on obstacles

# A finger and its servo, of the same file and of grasp.xml.
_MASS = 104.0  # kilograms, with the armature
_STIFFNESS = 30_000.0  # newtons per metre
_DAMPING = 1_000.0  # newton seconds per metre
_FARTHEST = 0.2  # metres, farthest target of the servo
_OPEN = 0.05  # metres from the middle, of a finger of an open hand
_SQUEEZE = 0.01  # metres, most distance between a finger and its reference, which bounds its squeeze of a cube


class GripperResponse:
    """A point that follows a target as the Fetch's gripper follows its mocap body.

    Args:
      position: at the start, `[3]`, metres.
    """

    def __init__(self, position: np.ndarray) -> None:
        self.position, self._velocity = position.copy(), np.zeros(3)

    def lead(self, measured: np.ndarray, displacement: np.ndarray) -> np.ndarray:
        """Starts an action, and returns the target of the point in it, `[3]`, metres.

        Args:
          measured: `[3]`, the gripper's position, metres.
          displacement: `[3]`, the action's first three numbers.
        """
        self.position = measured + np.clip(self.position - measured, -_SLACK, _SLACK)
        return self.position + LEAD * displacement

    def follow(self, target: np.ndarray, time: float) -> None:
        """Moves towards a target, `[3]`, for some time, seconds: the solution of a critically damped spring."""
        behind = self.position - target
        slope = self._velocity + behind / _TIME_CONSTANT
        decay = np.exp(-time / _TIME_CONSTANT)
        self.position = target + (behind + slope * time) * decay
        self._velocity = (self._velocity - slope * time / _TIME_CONSTANT) * decay


class FingerResponse:
    """A gap that opens and closes as the one between the Fetch's fingers.

    Args:
      gap: at the start, metres.
    """

    def __init__(self, gap: float) -> None:
        self._finger, self._velocity = gap / 2, 0.0

    @property
    def gap(self) -> float:
        """The gap, metres."""
        return 2 * self._finger

    def lead(self, measured: float, command: float) -> float:
        """Starts an action, and returns the target of each finger, metres from the middle.

        Args:
          measured: the robot's gap, metres.
          command: the action's last number, by which a finger's servo leads the finger, metres.
        """
        self._finger = min(max(self._finger, measured / 2 - _SQUEEZE), measured / 2 + _SQUEEZE)
        return min(max(self._finger + command, 0.0), _FARTHEST)

    def follow(self, target: float, time: float) -> None:
        """Moves each finger towards a target, metres, for a short time, seconds: about a physics step."""
        self._velocity += time * (_STIFFNESS * (target - self._finger) - _DAMPING * self._velocity) / _MASS
        moved = self._finger + time * self._velocity
        self._finger = min(max(moved, 0.0), _OPEN)
        if moved != self._finger:  # at its limit
            self._velocity = 0.0

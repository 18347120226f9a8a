"""Response of the Fetch's fingers to an action, which other hands track: policies trained on it expect that pace."""

# A finger and its servo, of assets/robots/fetch_hand.xml and of grasp.xml.
_MASS = 104.0  # kilograms, with the armature
_STIFFNESS = 30_000.0  # newtons per metre
_DAMPING = 1_000.0  # newton seconds per metre
_FARTHEST = 0.2  # metres, farthest target of the servo
_OPEN = 0.05  # metres from the middle, of a finger of an open hand
_SQUEEZE = 0.01  # metres, most distance between a finger and its reference, which bounds its squeeze of a cube


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

"""Earlier actions and observations, as a policy on a robot reads them before the present observation."""

import collections

import numpy as np

from hgail_envs.randomization import Randomization


class Past:
    """The past of one episode, as `RandomizedEnv` shows it: actions on their way, then past actions and observations.

    The randomization is that of the policy's training, with its `known_delay` and `history`; `delay` is the robot's,
    from an observation to the action that answers it, steps; `action_size` is by default that of the Fetch. A delay
    that is longer than the policy knows, if it knows any, is a ValueError.
    """

    def __init__(self, randomization: Randomization, delay: int = 0, action_size: int = 4) -> None:
        known, self._history = randomization.known_delay, randomization.history
        if known and not 0 <= delay <= known:
            raise ValueError(f"delay is {delay}; the policy knows delays from 0 to {known}")
        self._delay, self._action_size = delay, action_size
        self._sent = collections.deque([np.zeros(action_size)] * known, maxlen=known)
        self._rows: collections.deque[np.ndarray] = collections.deque(maxlen=self._history)

    def before(self, seen: np.ndarray) -> np.ndarray:
        """Returns the numbers before the features `seen`, `[n]`; the history at first repeats these.

        They are `known_delay * (1 + action_size) + history * (action_size + n)`.
        """
        if not self._rows:
            self._rows.extend([np.append(np.zeros(self._action_size), seen)] * self._history)
        sent = [(index < self._delay) * np.append(1.0, action) for index, action in enumerate(self._sent)]
        return np.concatenate([np.zeros(0), *sent, *self._rows])

    def send(self, action: np.ndarray) -> None:
        """Adds an action, `[action_size]`, that answers no observation, such as standing still."""
        self._sent.appendleft(action)

    def add(self, action: np.ndarray, seen: np.ndarray) -> None:
        """Adds an action, `[action_size]`, and the features that it answered, after `before` of these."""
        self.send(action)
        self._rows.appendleft(np.append(action, seen))

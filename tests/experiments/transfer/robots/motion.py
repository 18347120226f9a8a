"""What several tests of robots share."""

import numpy as np


def move(robot, actions):
    """Returns what is seen after each action, from a start."""
    robot.reset(np.random.default_rng(0))
    seen = [robot.features()]
    for action in actions:
        robot.step(np.array(action))
        seen.append(robot.features())
    return np.array(seen)

"""Gymnasium-Robotics' Fetch, on C MuJoCo with the robot's own meshes."""

from typing import Any

import numpy as np

import envs
from envs.fetch.grasp import is_held
from experiments.transfer.robots.base import Robot

_FINGERS = ("robot0:r_gripper_finger_link", "robot0:l_gripper_finger_link")
_LARGEST_ACTION = np.array([2.0, 2.0, 2.0, 1.0])  # see `Robot.step`
_MOST_SEED = 2**31


class GymnasiumFetch(Robot):
    """FetchReach-v4 or FetchPickAndPlace-v4.

    Starts and goals are the environment's own, except that the goal of grasp is the cube: the place where
    FetchPickAndPlace wants the cube is ignored. The features are taken from the environment's observation, whose
    velocities are already multiplied by `CONTROL_PERIOD`:

    | feature | FetchReach | FetchPickAndPlace |
    |---|---|---|
    | gripper position | 0:3 | 0:3 |
    | gripper velocity × 0.04 s | 5:8 | 20:23 |
    | gap between the fingers | not seen | the sum of 9:11 |
    | holding | not seen | `envs.fetch.grasp.is_held` of the contacts and the gap |
    | target position | the desired goal | 3:6, the cube |

    Actions are the same four numbers.

    Args:
      task: `"reach"` or `"grasp"`.

    """

    name = "Fetch, Gymnasium-Robotics on C MuJoCo"
    extra = "compare"
    packages = ("gymnasium-robotics",)

    offset = np.zeros(3)
    cube = "object0"
    marker = "target0"

    def __init__(self, task: str) -> None:
        import gymnasium  # here, so that the class can be read without its extra
        import gymnasium_robotics

        gymnasium.register_envs(gymnasium_robotics)
        self.task = task
        name: Any = envs.find_class(task).reference
        env: Any = gymnasium.make(name, disable_env_checker=True).unwrapped
        env.action_space = gymnasium.spaces.Box(-_LARGEST_ACTION, _LARGEST_ACTION, dtype=np.float64)  # it clips to this
        self.model, self.data = env.model, env.data
        self._env = env
        self._fingers = {self.model.geom(name).id for name in _FINGERS}

    def reset(self, rng: np.random.Generator) -> None:
        """Starts an episode of the environment, which `rng` seeds."""
        self._env.reset(seed=int(rng.integers(_MOST_SEED)))

    def features(self) -> np.ndarray:
        """Returns the features of `Reach`, `[6]`, or `Grasp`, `[8]`."""
        observation = self._env._get_obs()["observation"]
        if self.task == "reach":
            return np.concatenate([observation[:3], observation[5:8]])
        gap = observation[9:11].sum()
        return np.concatenate([observation[:3], observation[20:23], [gap, is_held(self._touching(), gap)]])

    def target(self) -> np.ndarray:
        """Returns the desired goal of reach, or the cube's centre, `[3]`."""
        seen = self._env._get_obs()
        return seen["desired_goal"] if self.task == "reach" else seen["observation"][3:6]

    def step(self, action: np.ndarray) -> None:
        """Steps the environment by an action, `[4]`."""
        self._env.step(np.asarray(action, np.float64))

    def _touching(self) -> bool:
        """Returns whether both fingers touch the cube."""
        cube = self.model.geom(self.cube).id
        pairs = self.data.contact.geom
        return self._fingers <= set(pairs[(pairs == cube).any(axis=1)].ravel())

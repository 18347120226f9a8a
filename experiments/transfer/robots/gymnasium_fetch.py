"""Gymnasium-Robotics' Fetch, on C MuJoCo with the robot's own meshes."""

from typing import Any

import numpy as np

import hgail_envs
from experiments.reference import make_reference
from experiments.transfer.robots.base import Robot
from hgail_envs.fetch.grasp import is_held
from hgail_envs.fetch.objects import OBSERVATIONS
from hgail_envs.validation import MOST_SEED, check_name

_FINGERS = ("robot0:r_gripper_finger_link", "robot0:l_gripper_finger_link")
_LARGEST_ACTION = np.array([2.0, 2.0, 2.0, 1.0])  # see `Robot.step`


class GymnasiumFetch(Robot):
    """The reference environment of a task: FetchReach-v4, FetchPickAndPlace-v4, FetchPush-v4 or FetchSlide-v4.

    Starts and goals are the environment's own, except that the goal of grasp is the cube: the place where
    FetchPickAndPlace wants the cube is ignored. So is the success, but for grasp. The features are taken from the
    environment's observation, whose velocities are already multiplied by `CONTROL_PERIOD`:

    | feature | FetchReach | the others |
    |---|---|---|
    | gripper position | 0:3 | 0:3 |
    | gripper velocity × 0.04 s | 5:8 | 20:23 |
    | object position less gripper position, object position | not seen | 6:9, 3:6; not seen in grasp |
    | object velocity × 0.04 s | not seen | the sum of 14:17 and 20:23; not seen in grasp |
    | gap between the fingers | not seen | the sum of 9:11; not seen in push and slide |
    | holding | not seen | `hgail_envs.fetch.grasp.is_held` of the contacts and the gap; likewise |
    | target position | the desired goal | the desired goal; in grasp 3:6, the cube |

    Actions are the same four numbers.

    Args:
      task: one of `tasks`.
      observation: `"compact"`, the features above, or `"official"`, for policies that read the environment's own 25
        numbers (`hgail_envs.fetch.objects.ObjectEnv.official_features`).

    Raises:
      ValueError: the task has no such observation.

    """

    name = "Fetch, Gymnasium-Robotics on C MuJoCo"
    extra = "compare"
    packages = ("gymnasium-robotics",)
    tasks = ("reach", "grasp", "push", "pick-and-place", "slide")
    unaffected_by = ("gravity",)  # the model compensates none

    offset = np.zeros(3)
    cube = "object0"
    marker = "target0"

    def __init__(self, task: str, observation: str = "compact") -> None:
        import gymnasium  # here, so that the class can be read without its extra

        self.task = task
        has_object_in_sight = "observation" in hgail_envs.accepted_options(task)
        check_name("observation", observation, OBSERVATIONS if has_object_in_sight else OBSERVATIONS[:1])
        self._official = observation == "official"
        name: Any = hgail_envs.find_class(task).reference
        env: Any = make_reference(name, disable_env_checker=True).unwrapped
        env.action_space = gymnasium.spaces.Box(-_LARGEST_ACTION, _LARGEST_ACTION, dtype=np.float64)  # it clips to this
        self.model, self.data = env.model, env.data
        self._env = env
        self._fingers = {self.model.geom(name).id for name in _FINGERS}

    def reset(self, rng: np.random.Generator) -> None:
        """Starts an episode of the environment, which `rng` seeds."""
        self._env.reset(seed=int(rng.integers(MOST_SEED + 1)))

    def features(self) -> np.ndarray:
        """Returns the features of the task's class in `hgail_envs`, with the same `observation`."""
        seen = self._observation()
        if self._official:
            return seen
        if self.task == "reach":
            return np.concatenate([seen[:3], seen[5:8]])
        gap = seen[9:11].sum()
        arm, hand = np.concatenate([seen[:3], seen[20:23]]), [gap, is_held(self._touching(), gap)]
        if self.task == "grasp":
            return np.concatenate([arm, hand])
        thing = np.concatenate([seen[6:9], seen[3:6], seen[14:17] + seen[20:23]])
        return np.concatenate([arm, thing, hand if self.task == "pick-and-place" else []])

    def target(self) -> np.ndarray:
        """Returns the desired goal, or in grasp the cube's centre, `[3]`."""
        return self._observation()[3:6] if self.task == "grasp" else self._env.goal.copy()

    def carried(self) -> np.ndarray:
        """Returns the gripper's position in reach and grasp, else the object's, `[3]`."""
        return self._observation()[:3] if self.task in ("reach", "grasp") else self._observation()[3:6]

    def reached(self) -> bool:
        """Returns whether the environment counts a success; in grasp, whether the gripper is near the cube."""
        return (
            super().reached() if self.task == "grasp" else bool(self._env._is_success(self.carried(), self._env.goal))
        )

    def step(self, action: np.ndarray) -> None:
        """Steps the environment by an action, `[4]`."""
        self._env.step(np.asarray(action, np.float64))

    def _observation(self) -> np.ndarray:
        return self._env._get_obs()["observation"]

    def _touching(self) -> bool:
        """Returns whether both fingers touch the cube."""
        cube = self.model.geom(self.cube).id
        pairs = self.data.contact.geom
        return self._fingers <= set(pairs[(pairs == cube).any(axis=1)].ravel())

"""Gymnasium-Robotics' environments, the reference of the Fetch tasks, on C MuJoCo with the robot's own meshes."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from hgail_envs.base import EpisodeMetrics
from hgail_envs.past import Past
from hgail_envs.registry import TASKS, accepted_options, find_class
from hgail_envs.tasks.grasp import CUBES, is_held
from hgail_envs.tasks.layouts import official
from hgail_envs.tasks.numpy_episode import run_episode
from hgail_envs.tasks.objects import OBSERVATIONS
from hgail_envs.validation import MOST_SEED, check_name

_FINGERS = ("robot0:r_gripper_finger_link", "robot0:l_gripper_finger_link")
_LARGEST_ACTION = np.array([2.0, 2.0, 2.0, 1.0])  # the displacements of an episode with a longer stride


def make_reference(name: str, **options: Any) -> Any:
    """Makes an environment of Gymnasium-Robotics, e.g. `"FetchReach-v4"`, on whatever MuJoCo is installed."""
    import gymnasium  # here, so that this module imports without the extra
    import gymnasium_robotics
    from gymnasium_robotics.utils import mujoco_utils

    # It tests whether a NumPy integer is `in` a tuple of joint types, which newer MuJoCos' enums never equal.
    kinds = {name: int(kind) for name, kind in mujoco.mjtJoint.__members__.items()}
    mujoco_utils.mujoco = SimpleNamespace(**vars(mujoco) | {"mjtJoint": SimpleNamespace(**kinds)})
    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make(name, **options)


def reference_tasks() -> tuple[str, ...]:
    """Returns the names of the tasks that have a reference."""
    return tuple(task for task in TASKS if find_class(task).reference)


class ReferenceFetch:
    """The reference environment of a task: FetchReach-v4, FetchPickAndPlace-v4, FetchPush-v4 or FetchSlide-v4.

    Starts, goals, successes and actions are the environment's own, except that the goal of grasp is the cube: the place
    where FetchPickAndPlace wants it is ignored. The features are taken from the environment's observation
    (`hgail_envs.tasks.layouts.official`, in FetchReach the gripper's position `0:3` and velocity `5:8`), whose
    velocities are already multiplied by `CONTROL_PERIOD`. See `hgail_envs.tasks.objects.ObjectEnv` for `observation`
    and `hgail_envs.tasks.grasp.Grasp` for `cube`. An ImportError says that the extra `compare` is not installed.
    """

    def __init__(self, task: str, observation: str = "compact", cube: str = CUBES[0]) -> None:
        check_name("task of the reference", task, reference_tasks())
        check_name("cube", cube, CUBES if task == "grasp" else CUBES[:1])
        has_object_in_sight = "observation" in accepted_options(task)
        check_name("observation", observation, OBSERVATIONS if has_object_in_sight else OBSERVATIONS[:1])
        self.task = task
        self._official = observation == "official"
        self._layout = find_class(task).features_with(observation=observation, cube=cube)
        self.tracks_cube = cube == "tracked"
        env: Any = make_reference(str(find_class(task).reference), disable_env_checker=True).unwrapped
        import gymnasium  # here, so that the class can be read without its extra

        env.action_space = gymnasium.spaces.Box(-_LARGEST_ACTION, _LARGEST_ACTION, dtype=np.float64)  # it clips to this
        self.model, self.data = env.model, env.data
        self.scene = str(env.fullpath)
        """Its MJCF file."""
        self._env = env
        self._fingers = {self.model.geom(name).id for name in _FINGERS}

    def reset(self, rng: np.random.Generator) -> None:
        """Starts an episode of the environment, which `rng` seeds."""
        self._env.reset(seed=int(rng.integers(MOST_SEED + 1)))

    def features(self) -> np.ndarray:
        """Returns the features of the task's class in `hgail_envs`, with the same options."""
        seen = self._observation()
        if self._official:
            return seen
        if self.task == "reach":
            return self._layout.join({"gripper position": seen[:3], "gripper velocity": seen[5:8]}, np)
        thing = getattr(find_class(self.task), "object_title", "cube")
        known = official(thing).split(seen)
        gap = known["position of the right finger"] + known["position of the left finger"]
        known |= {
            "gap between the fingers": gap,
            "hand holds the cube": is_held(self._touching(), gap),
            f"{thing} velocity": known[f"{thing} velocity less gripper velocity"] + known["gripper velocity"],
        }
        return self._layout.join({quantity.title: known[quantity.title] for quantity in self._layout}, np)

    def target(self) -> np.ndarray:
        """Returns the desired goal, or in grasp the cube's centre, `[3]`."""
        return self._observation()[3:6] if self.task == "grasp" else self._env.goal.copy()

    def carried(self) -> np.ndarray:
        """Returns the gripper's position in reach and grasp, else the object's, `[3]`."""
        return self._observation()[:3] if self.task in ("reach", "grasp") else self._observation()[3:6]

    def reached(self) -> bool:
        """Returns whether the environment counts a success; in grasp, whether the gripper is near the cube."""
        if self.task == "grasp":
            return bool(np.linalg.norm(self.carried() - self.target()) <= find_class(self.task).success_threshold)
        return bool(self._env._is_success(self.carried(), self._env.goal))

    def step(self, action: np.ndarray) -> None:
        """Steps the environment by an action, `[4]`."""
        self._env.step(np.asarray(action, np.float64))

    def _observation(self) -> np.ndarray:
        return self._env._get_obs()["observation"]

    def _touching(self) -> bool:
        cube = self.model.geom("object0").id
        pairs = self.data.contact.geom
        return self._fingers <= set(pairs[(pairs == cube).any(axis=1)].ravel())


def reference_episode(
    reference: ReferenceFetch, policy: Callable[[np.ndarray], np.ndarray], past: Past, seed: int, index: int
) -> EpisodeMetrics:
    """Runs a policy for one episode of the reference, with the task's lift test; returns plain numbers.

    `policy` maps an observation, float32 `[observation_size]`, to an action, `[4]`; `past` is that of its
    randomisation, still empty. The seed, of all episodes, and the episode's index decide the start.
    """
    reference.reset(np.random.default_rng((seed, index)).spawn(2)[0])
    at_start = reference.target()
    flags = np.ones(find_class(reference.task).goal_size - 3)  # the object's position, or to be held

    def act() -> np.ndarray:
        seen, target = reference.features(), reference.target() if reference.tracks_cube else at_start
        observation = np.concatenate([past.before(seen), seen, target, flags])
        action = np.clip(policy(observation.astype(np.float32)), -1.0, 1.0)
        past.add(action, seen)
        return action

    return run_episode(reference, act)

"""The tasks as environments of LeRobot: `--env.type=hgail --env.task=push`."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from draccus.utils import DecodingError
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from hgail_envs import GoalEnv, State, find_class
from hgail_envs.registry import check_takes_robot
from hgail_envs.vector import GoalVectorEnv, make_task
from hgail_envs.vision.camera_env import CameraEnv, known_numbers
from hgail_envs.vision.pictures import Pictures
from hgail_envs.vision.rendering import RenderingError

_STATE, OBSERVATION, _PICTURES = "agent_pos", "environment_state", "pixels"  # as LeRobot's roll-outs have them


def sentence(task: str) -> str:
    """Returns a task's instruction in words; its name where it has none."""
    return find_class(task).instruction or task


def state_numbers(env: GoalEnv) -> np.ndarray:
    """Returns the places in a task's observation of LeRobot's state: the robot's own numbers, and the goal's."""
    return env.known if isinstance(env, CameraEnv) else known_numbers(env, "given")


def observation_space(env: GoalEnv) -> spaces.Dict:
    """Returns the space of an observation of one environment, see `HgailVectorEnv`."""

    def box(size: int) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, (size,), np.float32)

    state = box(state_numbers(env).size)
    if not isinstance(env, CameraEnv):
        return spaces.Dict({_STATE: state, OBSERVATION: box(env.observation_size)})
    picture: spaces.Space = spaces.Box(0, 255, env.pictures.shape[1:], np.uint8)
    pictures = dict.fromkeys(env.pictures.cameras, picture)
    return spaces.Dict({_STATE: state, _PICTURES: spaces.Dict(pictures)})


class HgailVectorEnv(GoalVectorEnv):
    """Many episodes of a task at once, with LeRobot's observations.

    `agent_pos`, `[num_envs, numbers]`, are the numbers that a robot knows: its own, and the goal's unless that is seen.
    A `CameraEnv` has `pixels` of each camera by its name, uint8 `[num_envs, size, size, 3]`; another task
    `environment_state`, `[num_envs, observation_size]`: its observation, which policies of this package read.

    `info["is_success"]` is whether an episode ended at the goal, and false before its end: LeRobot counts an episode as
    a success if any step was one.
    """

    def __init__(self, task: str, env: GoalEnv, num_envs: int) -> None:
        super().__init__(env, num_envs, render_mode="rgb_array")
        self.single_observation_space = observation_space(env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.task, self.task_description, self._max_episode_steps = task, sentence(task), self._length

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts an episode in all environments; LeRobot's options say no more than that it is a new one."""
        return super().reset(seed=seed)

    def step(self, actions: np.ndarray) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes an action in all environments; see the base class."""
        observation, reward, terminated, truncated, info = super().step(actions)
        return observation, reward, terminated, truncated, info | {"is_success": info["is_success"] & truncated}

    def call(self, name: str) -> tuple[Any, ...]:
        """Returns an attribute of each environment; for `"render"` a picture of the first, which alone is filmed.

        LeRobot films as many of a batch as there are pictures, and on a CPU one takes a tenth of a second.
        """
        if name != "render":
            return (getattr(self, name),) * self.num_envs
        assert self._state is not None  # after a reset
        pose, goal = self._state.pipeline_state.qpos[0], self._state.info["desired_goal"][0]
        return (self._view.picture(np.asarray(pose), np.asarray(goal)),)

    get_attr = call

    def _seen(self, state: State) -> tuple[dict[str, Any], dict[str, Any]]:
        seen, info = super()._seen(state)
        observation = np.array(state.obs, np.float32)
        parts: dict[str, Any] = {_STATE: observation[:, state_numbers(self.env)]}
        if not isinstance(self.env, CameraEnv):
            return parts | {OBSERVATION: observation}, info
        pictures = np.moveaxis(seen["pixels"], 1, 0)
        return parts | {_PICTURES: dict(zip(self.env.pictures.cameras, pictures, strict=True))}, info


@EnvConfig.register_subclass("hgail")
@dataclasses.dataclass
class HgailEnvConfig(EnvConfig):
    """Options of a task, from which features and steps per second follow.

    A DecodingError, of which LeRobot's commands print one line, says that there is no such task, robot or camera, or no
    OpenGL.
    """

    fps: int = 0
    """Steps per second, which the task has; none other can be chosen."""
    task: str | None = "pick-and-place"
    """A task's name, or 'module:Class' of your own."""
    robot: str | None = None
    """The robot that acts, of a task of an arm; the Fetch unless it is named."""
    cameras: str = ""
    """Cameras of the scene, with commas between them; none unless they are named."""
    picture_size: int = 96
    """Edge of the square pictures, pixels."""
    target: str = "given"
    """Target by its numbers in the state, `given`, or as a ball in the pictures, `seen`."""

    def __post_init__(self) -> None:
        try:
            env = self._make(1)
            steps = round(1 / env.control_period)
            if self.fps not in (0, steps):
                raise ValueError(f"fps is {self.fps}; {self.task} has {steps} steps per second")
        except (ValueError, RenderingError) as error:
            raise DecodingError(("env",), str(error)) from error
        self.fps = steps
        space = observation_space(env)
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, (env.action_size,))}
        self.features[_STATE] = PolicyFeature(FeatureType.STATE, space[_STATE].shape)
        self.features_map = {ACTION: ACTION, _STATE: OBS_STATE, OBSERVATION: OBS_ENV_STATE}
        if isinstance(env, CameraEnv):
            images = [f"{OBS_IMAGES}.{camera}" for camera in env.pictures.cameras]
            self.features |= dict.fromkeys(images, PolicyFeature(FeatureType.VISUAL, env.pictures.shape[1:]))
            self.features_map |= dict(zip(images, images, strict=True))
        else:
            self.features[OBSERVATION] = PolicyFeature(FeatureType.ENV, space[OBSERVATION].shape)

    @property
    def gym_kwargs(self) -> dict:
        """Returns nothing: Gymnasium's registry is not asked."""
        return {}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, HgailVectorEnv]]:
        """Returns the task's environments, which one process steps, as LeRobot nests them."""
        return {self.type: {0: HgailVectorEnv(str(self.task), self._make(n_envs), n_envs)}}

    def _make(self, num_envs: int) -> GoalEnv:
        robot: Mapping[str, str] = {} if self.robot is None else {"robot": self.robot}
        if robot:
            check_takes_robot(str(self.task))
        env = make_task(str(self.task), num_envs, **robot)
        if env.robot is None:
            raise ValueError(f"the task {self.task} has no scene that LeRobot could film")
        cameras = [name.strip() for name in self.cameras.split(",") if name.strip()]
        if not cameras and self.target == "given":
            if self.picture_size != HgailEnvConfig.picture_size:
                raise ValueError(f"picture_size is {self.picture_size}, and there are no cameras; name some")
            return env
        return CameraEnv(env, Pictures(env, cameras, self.picture_size, target=self.target))

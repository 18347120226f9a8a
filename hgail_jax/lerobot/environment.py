"""The tasks as environments of LeRobot: `--env.type=hgail --env.task=push`."""

import dataclasses
from typing import Any

import numpy as np
from draccus.utils import DecodingError
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from hgail_envs import GoalEnv, State
from hgail_envs.registry import check_takes_robot
from hgail_envs.vector import GoalVectorEnv, make_task
from hgail_envs.vision.camera_env import known_places
from hgail_envs.vision.pictures import Pictures

SENTENCES = {
    "reach": "Move the gripper to the target.",
    "grasp": "Grasp the cube.",
    "push": "Push the cube to the target.",
    "pick-and-place": "Grasp the cube and bring it to the target.",
    "slide": "Hit the puck so that it slides to the target.",
    "stack": "Put cube A on cube B and let go of it.",
    "tower": "Build a tower of three cubes.",
}
"""What a policy is told in words, by the task."""
PICTURE_SIZE = 96
"""Edge of a picture unless another is given, pixels."""
_STATE, _OBSERVATION, _PICTURES = "agent_pos", "environment_state", "pixels"  # as LeRobot's roll-outs have them


def sentence(task: str) -> str:
    """Returns what a policy of a task is told in words; of a task of one's own it is the name."""
    return SENTENCES.get(task, task)


def make(task: str, robot: str | None, num_envs: int) -> GoalEnv:
    """Makes a task; a ValueError says that there is no such task or robot."""
    if robot is not None:
        check_takes_robot(task)
    return make_task(task, num_envs, **({} if robot is None else {"robot": robot}))


class HgailVectorEnv(GoalVectorEnv):
    """Many episodes of a task at once, with LeRobot's observations.

    `agent_pos`, `[num_envs, numbers]`, are the numbers that a robot knows: its own, and the goal. With `cameras` there
    are `pixels` of each by its name, uint8 `[num_envs, picture_size, picture_size, 3]`; without, `environment_state`,
    `[num_envs, observation_size]`: the task's observation, which policies of this package read.

    `info["is_success"]` is whether an episode ended at the goal, and false before its end: LeRobot counts an episode as
    a success if any step was one.
    """

    def __init__(self, task: str, env: GoalEnv, num_envs: int, cameras: tuple[str, ...], picture_size: int) -> None:
        self._known, self._size, self._cameras = known_places(env), env.observation_size, cameras
        super().__init__(env, num_envs, render_mode="rgb_array", cameras=cameras, picture_size=picture_size)
        self.single_observation_space = observation_space(env, cameras, picture_size)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.task, self.task_description, self._max_episode_steps = task, sentence(task), self._length

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
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
        observation = np.array(state.obs[:, : self._size], np.float32)
        parts: dict[str, Any] = {_STATE: observation[:, self._known]}
        if not self._cameras:
            return parts | {_OBSERVATION: observation}, info
        pictures = np.moveaxis(seen["pixels"], 1, 0)
        return parts | {_PICTURES: dict(zip(self._cameras, pictures, strict=True))}, info


def observation_space(env: GoalEnv, cameras: tuple[str, ...], picture_size: int) -> spaces.Dict:
    """Returns the space of an observation of one environment, see `HgailVectorEnv`."""
    picture = spaces.Box(0, 255, (picture_size, picture_size, 3), np.uint8)
    sizes = {_STATE: known_places(env).size} | ({} if cameras else {_OBSERVATION: env.observation_size})
    parts: dict[str, Any] = {name: spaces.Box(-np.inf, np.inf, (size,), np.float32) for name, size in sizes.items()}
    return spaces.Dict(parts | ({_PICTURES: spaces.Dict(dict.fromkeys(cameras, picture))} if cameras else {}))


@EnvConfig.register_subclass("hgail")
@dataclasses.dataclass
class HgailEnvConfig(EnvConfig):
    """Options of a task, from which features and steps per second follow.

    A DecodingError, of which LeRobot's commands print one line, says that there is no such task, robot or camera.
    """

    task: str | None = "pick-and-place"
    """A task's name, or 'module:Class' of your own."""
    robot: str | None = None
    """The robot that acts, of a task of an arm; the Fetch unless it is named."""
    cameras: str = ""
    """Cameras of the scene by name, e.g. `front,side`; none unless they are named."""
    picture_size: int = PICTURE_SIZE
    """Edge of the square pictures, pixels."""

    def __post_init__(self) -> None:
        try:
            env = make(str(self.task), self.robot, 1)
            if self._cameras:
                Pictures(env, self._cameras, self.picture_size)
        except ValueError as error:
            raise DecodingError(("env",), str(error)) from error
        self.fps = round(1 / env.control_period)
        kinds = {_STATE: (FeatureType.STATE, OBS_STATE), _OBSERVATION: (FeatureType.ENV, OBS_ENV_STATE)}
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, (env.action_size,))}
        self.features_map = {ACTION: ACTION}
        for name, space in observation_space(env, self._cameras, self.picture_size).items():
            if name == _PICTURES:
                images = [f"{OBS_IMAGES}.{camera}" for camera in self._cameras]
                picture = PolicyFeature(FeatureType.VISUAL, (self.picture_size, self.picture_size, 3))
                self.features |= dict.fromkeys(images, picture)
                self.features_map |= dict(zip(images, images, strict=True))
            else:
                kind, self.features_map[name] = kinds[name]
                self.features[name] = PolicyFeature(kind, space.shape)

    @property
    def _cameras(self) -> tuple[str, ...]:
        return tuple(name.strip() for name in self.cameras.split(",") if name.strip())

    @property
    def gym_kwargs(self) -> dict:
        """Returns nothing: Gymnasium's registry is not asked."""
        return {}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, HgailVectorEnv]]:
        """Returns the task's environments, which one process steps, as LeRobot nests them."""
        task = str(self.task)
        env = make(task, self.robot, n_envs)
        return {self.type: {0: HgailVectorEnv(task, env, n_envs, self._cameras, self.picture_size)}}

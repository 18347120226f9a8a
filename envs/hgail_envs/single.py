"""A task as a single Gymnasium environment; `gymnasium.make("hgail_envs/FetchPush-v0")` makes one."""

import sys
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from hgail_envs.base import GoalEnv
from hgail_envs.vector import GoalVectorEnv, make_task
from hgail_envs.vision.pictures import SIZE


class GoalSingleEnv(gymnasium.Env):
    """One episode of a task at a time, with the spaces, rewards and `info` of a `GoalVectorEnv`.

    It has no time limit: `gymnasium.make` adds one of the task's `episode_length`. After `reset(seed=s)`
    its episodes are those of the first environment of a `GoalVectorEnv` with that seed. The task is one, or its
    name, made with the options, see `hgail_envs.make`. With `cameras` an observation has `pixels`, see
    `GoalVectorEnv`. With the `render_mode` `"rgb_array"`, `render` returns a picture; a task without a scene, or an
    unknown one, is a ValueError.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012  (as Gymnasium has it)

    def __init__(
        self,
        task: str | GoalEnv,
        render_mode: str | None = None,
        cameras: Sequence[str] = (),
        picture_size: int = SIZE,
        **options: Any,
    ) -> None:
        if isinstance(task, str):
            task = make_task(task, 1, **options)
        self.vector = GoalVectorEnv(
            task, 1, max_episode_steps=sys.maxsize, render_mode=render_mode, cameras=cameras, picture_size=picture_size
        )
        self.metadata = {name: self.vector.metadata[name] for name in ("render_modes", "render_fps")}
        self.render_mode = render_mode
        self.observation_space = self.vector.single_observation_space
        self.action_space = self.vector.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Starts an episode; without a seed, the one that follows the last."""
        super().reset(seed=seed)
        return _only(*self.vector.reset(seed=seed, options=options))

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Takes an action `[action_size]`, clipped to [-1, 1]."""
        batch, reward, _, _, batch_info = self.vector.step(np.asarray(action)[None])
        observation, info = _only(batch, batch_info)
        return observation, float(reward[0]), False, False, info

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any = None) -> np.ndarray | float:
        """Returns the rewards of goals, `[..., goal_size]` each, for a trainer that relabels."""
        rewards = self.vector.compute_reward(achieved, desired)
        return rewards if rewards.ndim else float(rewards)

    def render(self) -> np.ndarray | None:
        """Returns a picture, `[height, width, 3]`, uint8; None without a `render_mode`."""
        pictures = self.vector.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Frees the renderer."""
        self.vector.close()


def _only(observation: dict[str, np.ndarray], info: dict[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    return {name: value[0] for name, value in observation.items()}, {"is_success": bool(info["is_success"][0])}

"""A vector environment of this package as one of stable-baselines3, whose interface differs from Gymnasium's."""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from hgail_envs.vector import GoalVectorEnv


class GoalVecEnv(VecEnv):
    """A `GoalVectorEnv` as a `stable_baselines3.common.vec_env.VecEnv`, e.g. for SAC with `HerReplayBuffer`.

    Each environment's `info` has `is_success`, and at an episode's end `terminal_observation` and
    `TimeLimit.truncated`, as stable-baselines3 wants them. A ValueError says that the environment was not made with
    `autoreset_mode="SameStep"`.
    """

    def __init__(self, env: GoalVectorEnv) -> None:
        mode = env.metadata["autoreset_mode"]
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(f"autoreset_mode is {mode.value!r}; stable-baselines3 needs 'SameStep'")
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self.metadata |= {"render_fps": env.metadata["render_fps"]}  # of films

    def reset(self) -> dict[str, np.ndarray]:
        """Starts an episode in all environments, once with the seed that was last given to `seed`."""
        observation, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observation, reward, _, over, info = self.env.step(self._actions)
        success = info.get("final_info", info)["is_success"]
        infos: list[dict[str, Any]] = [{"is_success": bool(one)} for one in success]
        for one, final in zip(infos, info.get("final_obs", ()), strict=False):
            one |= {"terminal_observation": final, "TimeLimit.truncated": True}
        return observation, reward, over, infos

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Calls a method of the vector environment, e.g. `compute_reward`, once for each of `indices`."""
        return [getattr(self.env, method_name)(*args, **kwargs) for _ in self._get_indices(indices)]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self.env, attr_name, value)

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Returns False for each of `indices`: nothing is wrapped."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> list[np.ndarray]:
        """Returns a picture of each environment, of which `render` makes one."""
        return list(self.env.render() or ())

    def close(self) -> None:
        self.env.close()

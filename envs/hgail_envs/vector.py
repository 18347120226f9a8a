"""Adapter from a task of this package to Gymnasium's vector environments."""

import sys
from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from hgail_envs import registry
from hgail_envs.base import GoalEnv, State
from hgail_envs.scenes import SceneView
from hgail_envs.validation import MOST_SEED, check_count
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.pictures import SIZE, Pictures

_AUTORESET = (AutoresetMode.NEXT_STEP.value, AutoresetMode.SAME_STEP.value)
_OF_PICTURES = ("cameras", "picture_size")
_MOST_KEY = 2**32 - 1  # the largest seed of a JAX key


def make_vector(num_envs: int, task: str, max_episode_steps: int | None = None, **options: Any) -> "GoalVectorEnv":
    """Makes a vector environment from a task's name and options, for `gymnasium.make_vec`; see `GoalVectorEnv`."""
    own = {name: options.pop(name) for name in (*_OF_PICTURES, "render_mode", "autoreset_mode") if name in options}
    return GoalVectorEnv(make_task(task, num_envs, **options), num_envs, max_episode_steps=max_episode_steps, **own)


def make_task(task: str, num_envs: int, **options: Any) -> GoalEnv:
    """Makes a task for as many environments, unless its options have another number of `worlds`."""
    check_count("num_envs", num_envs)
    if "worlds" in registry.accepted_options(task):
        options.setdefault("worlds", int(num_envs))
    return registry.make(task, **options)


class GoalVectorEnv(VectorEnv):
    """Many episodes of a `GoalEnv` at once, as a `gymnasium.vector.VectorEnv`.

    An observation is a dictionary as in Gymnasium-Robotics: `observation`, the task's features (`[num_envs,
    feature_size]`), `achieved_goal` and `desired_goal` (`[num_envs, goal_size]`), all float32. Rewards are -1, or 0 at
    the goal. `info["is_success"]` holds booleans `[num_envs]`.

    No episode terminates; all are truncated after the same number of steps. By default, Gymnasium's `NEXT_STEP`, the
    step that follows ignores its actions, and returns the first observation of the next episode with reward 0. With
    `SAME_STEP` the step that truncates returns it, and the episodes' last observations and infos are in
    `info["final_obs"]` and `info["final_info"]`.

    Environment `i` draws its episodes from `jax.random.key(seed + i)`, whatever the number of environments: before each
    episode `key, episode_key = jax.random.split(key)`, and the episode is `env.reset(episode_key)`. A `reset` without
    a seed continues with the next episode.

    An episode has the task's `episode_length` unless `max_episode_steps` says otherwise. The `autoreset_mode` is a
    string (`"NextStep"`, `"SameStep"`) or Gymnasium's enumeration. With the `render_mode` `"rgb_array"`, `render`
    returns a picture of each environment.

    With `cameras`, names of cameras of the scene, an observation has `pixels` too: what they see, square pictures,
    uint8, `[num_envs, cameras, picture_size, picture_size, 3]`, without the target's marker. That starts JAX.

    Raises:
      TypeError: `env` is no `GoalEnv`.
      ValueError: a number is no integer or less than 1, more environments than the task's physics can step at once, an
        unknown mode, pictures of a task without a scene or such a camera, or
        a size of pictures without cameras.
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": ["rgb_array"]}  # noqa: RUF012  (as Gymnasium has it)

    def __init__(
        self,
        env: GoalEnv,
        num_envs: int,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        cameras: Sequence[str] = (),
        picture_size: int = SIZE,
    ) -> None:
        if not isinstance(env, GoalEnv):
            raise TypeError(f"env is {env!r}; it must be a GoalEnv")
        if cameras:
            env = CameraEnv(env, Pictures(env, cameras, picture_size))
        elif picture_size != SIZE:
            raise ValueError(f"picture_size is {picture_size}, and there are no cameras; name some")
        length = env.episode_length if max_episode_steps is None else max_episode_steps
        check_count("num_envs", num_envs)
        check_count("max_episode_steps", length, most=sys.maxsize)
        # There is room for one, and to ask for the room starts JAX; this may be a process that is about to fork.
        if num_envs > 1 and env.max_worlds is not None and num_envs > env.max_worlds:
            raise ValueError(f"num_envs is {num_envs}; the task was made for {env.max_worlds}: make it with worlds")
        self.env, self.num_envs = env, num_envs
        self._length, self._view, self.render_mode = length, SceneView(env, render_mode), render_mode
        mode = getattr(autoreset_mode, "value", autoreset_mode)
        if mode not in _AUTORESET:
            raise ValueError(f"autoreset_mode is {autoreset_mode!r}; choose from {', '.join(_AUTORESET)}")
        self._autoreset = AutoresetMode(mode)
        self.metadata = {
            "render_modes": [] if env.scene is None else ["rgb_array"],
            "render_fps": round(1 / env.control_period),
            "autoreset_mode": self._autoreset,
        }

        def box(size: int) -> gymnasium.spaces.Box:
            return gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)

        spaces: dict[str, gymnasium.Space] = {"observation": box(env.feature_size), "achieved_goal": box(env.goal_size)}
        spaces["desired_goal"] = box(env.goal_size)
        if isinstance(env, CameraEnv):
            spaces["pixels"] = gymnasium.spaces.Box(0, 255, env.pictures.shape, np.uint8)
        self.single_observation_space = gymnasium.spaces.Dict(spaces)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._keys: jax.Array | None = None
        self._state: State | None = None
        self._steps = 0
        self._define_programs()

    def _define_programs(self) -> None:
        self._reset, self._step = jax.jit(jax.vmap(self.env.reset)), jax.jit(jax.vmap(self.env.step))
        self._split = jax.jit(lambda keys: jnp.moveaxis(jax.vmap(jax.random.split)(keys), 1, 0))
        self._success = jax.jit(self.env.success)
        self._see = jax.jit(self.env.see) if isinstance(self.env, CameraEnv) else None

    def __getstate__(self) -> dict[str, Any]:
        """Returns what a pickle or a copy is made of: all but the programs, which are compiled again."""
        programs = ("_reset", "_step", "_split", "_success", "_see")
        return {name: value for name, value in vars(self).items() if name not in programs}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._define_programs()

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Starts an episode in all environments, which are reset together: there are no options, such as `reset_mask`.

        The seed is that of the first environment, from which the others count on, or there is one for each.

        Raises:
          ValueError: not as many seeds as environments, or a seed that is no integer or out of range; or there are
            options.
        """
        if options:
            raise ValueError(f"options are {', '.join(map(repr, options))}; there are none")
        if seed is None and self._keys is not None:
            return self._start(self._keys)
        if isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str):
            seeds = list(seed)
        else:
            if seed is not None:
                check_count("seed", seed, least=0, most=_MOST_KEY)
                super().reset(seed=int(seed))
            first = int(self.np_random.integers(MOST_SEED + 1)) if seed is None else int(seed)
            seeds = [first + index for index in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ValueError(f"there are {len(seeds)} seeds for {self.num_envs} environments")
        for one in seeds:
            check_count("seed", one, least=0, most=_MOST_KEY)
        return self._start(jax.vmap(jax.random.key)(np.asarray(seeds, np.uint32)))

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes an action `[num_envs, action_size]`, clipped to [-1, 1], in all environments; see the class.

        Raises:
          gymnasium.error.ResetNeeded: there was no `reset` before.
          ValueError: the actions have another shape, or not all of them are finite numbers.
        """
        if self._state is None or self._keys is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        if np.shape(actions) != self.action_space.shape:
            raise ValueError(f"actions have shape {np.shape(actions)}; it must be {self.action_space.shape}")
        actions = np.asarray(actions)
        if actions.dtype.kind not in "biuf" or not np.isfinite(actions).all():
            raise ValueError("not all actions are finite numbers")
        no = np.zeros(self.num_envs, bool)
        if self._steps == self._length:  # Gymnasium's NEXT_STEP: the reset takes a separate step
            observation, info = self._start(self._keys)
            return observation, np.zeros(self.num_envs), no, no.copy(), info
        self._state = self._step(self._state, np.asarray(actions, np.float32))
        self._steps += 1
        over = np.full(self.num_envs, self._steps == self._length)
        reward = np.asarray(self._state.reward, np.float64)
        observation, info = self._seen(self._state)
        if self._steps == self._length and self._autoreset == AutoresetMode.SAME_STEP:
            final_obs = np.empty(self.num_envs, object)  # Gymnasium has them as an object for each environment
            final_obs[:] = [{name: value[i] for name, value in observation.items()} for i in range(self.num_envs)]
            final = _marked({"final_obs": final_obs, "final_info": info}, self.num_envs)
            observation, info = self._start(self._keys)
            info = info | final
        return observation, reward, no, over, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Returns a picture of each environment, `[height, width, 3]`, uint8; None without a `render_mode`.

        Raises:
          gymnasium.error.ResetNeeded: there was no `reset` before.
          RenderingError: MuJoCo cannot render here.
        """
        if self.render_mode is None:
            return None
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before render")
        goals, poses = np.asarray(self._state.info["desired_goal"]), np.asarray(self._state.pipeline_state.qpos)
        return tuple(self._view.picture(pose, goal) for pose, goal in zip(poses, goals, strict=True))

    def close_extras(self, **kwargs: Any) -> None:
        self._view.close()

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any = None) -> np.ndarray:
        """Returns the rewards `[...]` of goals, `[..., goal_size]` each, for a trainer that relabels.

        Goals of two shapes, or of another size than the task's, are a ValueError.
        """
        size, (one, other) = self.env.goal_size, (np.asarray(goal, np.float32) for goal in (achieved, desired))
        if one.shape != other.shape or one.shape[-1:] != (size,):
            raise ValueError(
                f"achieved goals have the shape {one.shape}; desired ones {other.shape}, of {size} numbers"
            )
        rows = np.stack([one, other]).reshape(2, -1, size)
        count = rows.shape[1]
        # Whole powers of two, so that batches of many sizes share a few programs.
        padded = np.pad(rows, ((0, 0), (0, (1 << max(count - 1, 0).bit_length()) - count), (0, 0)))
        return np.asarray(self._success(*padded)[:count], np.float64).reshape(one.shape[:-1]) - 1.0

    def _start(self, keys: jax.Array) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        self._keys, episode_keys = self._split(keys)
        self._steps, self._state = 0, self._reset(episode_keys)
        return self._seen(self._state)

    def _seen(self, state: State) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        parts = {"observation": "features", "achieved_goal": "achieved_goal", "desired_goal": "desired_goal"}
        observation = {name: np.array(state.info[part], np.float32) for name, part in parts.items()}
        if self._see is not None:
            observation["pixels"] = np.array(self._see(state.obs))
        return observation, _marked({"is_success": np.asarray(state.reward) == 0.0}, self.num_envs)


def _marked(info: dict[str, Any], num_envs: int) -> dict[str, Any]:
    """Returns an info of Gymnasium's form: beside each entry, which environments have it."""
    return info | {f"_{name}": np.ones(num_envs, bool) for name in info}

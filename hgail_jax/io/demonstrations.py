"""Demonstrations as a file: whole episodes of an expert.

The file is an npz of float32 arrays, not compressed, with a header in JSON; NumPy alone reads it and nothing in it is
code. Of `K` episodes of `T` steps it holds `features` `[K, T, feature_size]` and `goal` `[K, T, goal_size]`, from
which the task makes the observations, `action` `[K, T, action_size]`, and per episode `[K]` `success` (0 or 1),
`returns` (the sum of the task's rewards) and `distance_l1` at the end. The header is

    {"format": "hgail_jax demonstrations 1", "task": "reach", "controller": "proportional", "seed": 0,
     "physics": {"impl": "jax", "substeps": 4}, "versions": {"hgail-jax": "0.1.0", "jax": "0.10.2"}}
"""

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from hgail_envs import GoalEnv
from hgail_jax.io.files import load_npz, save_npz
from hgail_jax.samples import Samples

_FORMAT = "hgail_jax demonstrations 1"
_STEPS = ("features", "goal", "action")
_EPISODES = ("success", "returns", "distance_l1")


@dataclasses.dataclass(frozen=True)
class Demonstrations:
    """`K` episodes of `T` steps; see the module for the arrays; a ValueError if they do not fit or are not finite."""

    task: str
    features: np.ndarray
    goal: np.ndarray
    action: np.ndarray
    success: np.ndarray
    returns: np.ndarray
    distance_l1: np.ndarray
    made_by: dict = dataclasses.field(default_factory=dict)
    """Further entries of the header: controller, seed, physics, versions."""

    def __post_init__(self) -> None:
        for name in _STEPS + _EPISODES:
            array = getattr(self, name)
            if array.dtype != np.float32 or not np.isfinite(array).all():
                raise ValueError(f"{name} is not all finite float32 numbers")
            if array.ndim != (3 if name in _STEPS else 1) or array.size == 0:
                raise ValueError(f"{name} has the shape {array.shape}")
        if len({getattr(self, name).shape[:2] for name in _STEPS}) > 1:
            raise ValueError("features, goal and action differ in their episodes or steps")
        if any(getattr(self, name).shape != (self.episodes,) for name in _EPISODES):
            raise ValueError(f"success, returns and distance_l1 are not of {self.episodes} episodes each")

    @property
    def episodes(self) -> int:
        """Number of episodes, `K`."""
        return len(self.action)

    @property
    def sha256(self) -> str:
        """Hash of features, goals and actions, whichever controller made them."""
        arrays = [np.ascontiguousarray(getattr(self, name)) for name in _STEPS]
        return hashlib.sha256(b"".join(str(array.shape).encode() + array.tobytes() for array in arrays)).hexdigest()

    def first(self, episodes: int) -> "Demonstrations":
        """Returns the first so many episodes; a ValueError says that there are not as many."""
        if not 0 < episodes <= self.episodes:
            raise ValueError(f"there are {self.episodes} demonstrations; {episodes} are asked for")
        arrays = {name: getattr(self, name)[:episodes] for name in _STEPS + _EPISODES}
        return dataclasses.replace(self, **arrays)

    def validate(self, env: GoalEnv) -> "Demonstrations":
        """Returns itself; a ValueError says that the sizes are not the task's."""
        sizes = (env.feature_size, env.goal_size, env.action_size)
        found = tuple(getattr(self, name).shape[-1] for name in _STEPS)
        if found != sizes:
            raise ValueError(
                f"demonstrations have features, goals and actions of the sizes {found}; the task: {sizes}. hgail demos"
                " has a --learner, whose observation they hold"
            )
        return self

    def samples(self, env: GoalEnv) -> Samples:
        """Returns all steps as expert samples of equal weight, leaves `[K * T, ...]`; see `validate`."""
        self.validate(env)
        arrays = (jnp.asarray(getattr(self, name)) for name in _STEPS)
        features, goal, action = (array.reshape(-1, array.shape[-1]) for array in arrays)
        return Samples(env.goal_observation(features, goal), action, jnp.ones(len(action)))


def save_demonstrations(path: Path | str, demonstrations: Demonstrations) -> None:
    """Writes demonstrations; see the module for the format."""
    header = {"format": _FORMAT, "task": demonstrations.task} | demonstrations.made_by
    save_npz(path, header, {name: getattr(demonstrations, name) for name in _STEPS + _EPISODES})


def load_demonstrations(path: Path | str, task: str) -> Demonstrations:
    """Reads demonstrations of a task, written by `save_demonstrations`; the file need not be trusted.

    Raises:
      FileNotFoundError: there is no such file.
      ValueError: the file holds no demonstrations, or those of another task.
    """
    demonstrations = load_npz(path, "demonstrations", {_FORMAT: _from_file})
    if demonstrations.task != task:
        raise ValueError(f"{path} demonstrates {demonstrations.task!r}, not {task!r}")
    return demonstrations


def _from_file(header: dict, file: Mapping[str, np.ndarray]) -> Demonstrations:
    made_by = {name: value for name, value in header.items() if name not in ("format", "task")}
    return Demonstrations(header["task"], **{name: file[name] for name in _STEPS + _EPISODES}, made_by=made_by)

"""A trained policy that sees pictures."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hgail_envs import GoalEnv
from hgail_envs.randomization import Randomization
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.look import LOOKS
from hgail_envs.vision.pictures import KINDS
from hgail_jax.vision.augmentation import AUGMENTATIONS
from hgail_jax.vision.network import KERNELS, Eyes, look


def sizes_of_look(look: str, kind: str) -> dict[str, Any]:
    """Returns the sizes that a look's name stands for in this version: of the scene's, and of the images' variation.

    The images are of a kind, a name in `hgail_envs.vision.pictures.KINDS`.
    """
    return {"scene": dataclasses.asdict(LOOKS[look]), "image": dataclasses.asdict(AUGMENTATIONS[kind][look])}


@dataclasses.dataclass(frozen=True)
class CameraPolicy:
    """The action of a policy that sees pictures; a ValueError if its arrays do not fit or are not finite."""

    task: str
    goal_size: int
    """Size of the desired goal, the last of the numbers; 0 if the policy sees the target instead."""
    cameras: tuple[str, ...]
    """Names of the scene's cameras, in the order of the pictures."""
    size: int
    """Edge of the square pictures, pixels."""
    mean: np.ndarray = dataclasses.field(repr=False)
    """Mean of the numbers that it takes, `[numbers]`, for normalisation."""
    std: np.ndarray = dataclasses.field(repr=False)
    """Their standard deviation, `[numbers]`."""
    centre: np.ndarray = dataclasses.field(repr=False)
    """Mean positions of the objects and of a marker that it sees, `[3 objects]`, metres; it predicts offsets."""
    eyes: Eyes = dataclasses.field(repr=False)
    """Its network."""
    versions: dict[str, str | None] = dataclasses.field(default_factory=dict)
    """Versions of the packages that trained it."""
    task_options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the task's class that it was trained with."""
    look: str = "plain"
    """How the look of the scene varied in its training."""
    look_sizes: dict[str, Any] = dataclasses.field(default_factory=dict)
    """By how much, see `sizes_of_look`; empty in older files."""
    kind: str = "colour"
    """Kind of its pictures, `"colour"` or `"depth"`."""

    randomization = Randomization()
    """Randomisation of its training episodes: none."""

    def __post_init__(self) -> None:
        arrays = [self.mean, self.std, self.centre, *jax.tree.leaves(self.eyes)]
        if not all(array.dtype == np.float32 and np.isfinite(array).all() for array in arrays):
            raise ValueError("not all of its arrays are finite float32 numbers")
        if not (0 <= self.goal_size < self.mean.size and self.mean.shape == self.std.shape and (self.std > 0).all()):
            raise ValueError("its normalisation does not fit its numbers")
        if len(self.eyes.convolutions) != len(KERNELS) or not self.eyes.hidden:
            raise ValueError("it does not have the layers of a network of pictures")
        given = [jax.ShapeDtypeStruct((1, *shape), jnp.float32) for shape in (self.pictures_shape, self.mean.shape)]
        try:
            _, objects = jax.eval_shape(look, self.eyes, *given)
        except (TypeError, ValueError):
            raise ValueError("its layers do not fit together") from None
        if objects.shape[1:] != self.centre.shape:
            raise ValueError("its layers do not fit its objects")

    @property
    def pictures_shape(self) -> tuple[int, int, int, int]:
        """Shape of what it sees at a time."""
        return len(self.cameras), self.size, self.size, KINDS[self.kind]

    @property
    def target(self) -> str:
        """How it learns where the target is: `"given"` by numbers, or `"seen"` in the pictures."""
        return "given" if self.goal_size else "seen"

    @property
    def action_size(self) -> int:
        """Numbers in an action."""
        return self.eyes.action[1].size

    def __call__(self, pictures: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Returns actions in [-1, 1], `[..., action_size]`, for pictures and the numbers that the robot knows.

        Pictures are uint8, `[..., cameras, size, size, 3]`, the upper row first and red first, or of depth `[...,
        cameras, size, size, 1]`. The numbers, `[..., numbers]`, are as they are. A ValueError says that they have
        another shape, or another range, or are not finite.
        """
        pictures, numbers = np.asarray(pictures), np.asarray(numbers, np.float32)
        if pictures.shape[-4:] != self.pictures_shape:
            raise ValueError(
                f"pictures have the shape {pictures.shape}; the policy sees {self.pictures_shape}:"
                f" {', '.join(self.cameras)}, {self.size} x {self.size}, {self.kind}"
            )
        if pictures.dtype != np.uint8:
            raise ValueError(f"pictures are {pictures.dtype}; they must be uint8, from 0 to 255")
        if numbers.shape[-1:] != self.mean.shape:
            raise ValueError(f"the policy takes {self.mean.size} numbers beside the pictures")
        if pictures.shape[:-4] != numbers.shape[:-1]:
            raise ValueError(f"a batch of pictures is {pictures.shape[:-4]}, and that of numbers {numbers.shape[:-1]}")
        if not np.isfinite(numbers).all():
            raise ValueError("not all of the numbers beside the pictures are finite")
        flat = pictures.reshape(-1, *self.pictures_shape), numbers.reshape(-1, self.mean.size)
        return np.asarray(act(self.parameters(), *flat)).reshape(*numbers.shape[:-1], self.action_size)

    def parameters(self) -> Any:
        """Returns the arrays of `act_in`."""
        return self.mean, self.std, self.eyes


def act_in(env: CameraEnv, parameters: Any, observation: jax.Array) -> jax.Array:
    """Returns the actions, `[N, action_size]`, for observations of a task with pictures, `[N, observation_size]`."""
    return act(parameters, env.see(observation), observation[:, env.known])


def acting(env: GoalEnv, policy: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Returns a policy of either kind as a function of an observation, `[observation_size]`, to an action.

    A ValueError says that the policy sees pictures and the task has none.
    """
    if not isinstance(policy, CameraPolicy):
        return policy
    if not isinstance(env, CameraEnv):
        raise ValueError(f"the policy sees pictures of {', '.join(policy.cameras)}; the task gives positions")
    in_env = jax.jit(functools.partial(act_in, env))
    return lambda observation: np.asarray(in_env(policy.parameters(), observation[None])[0])


@jax.jit
def act(parameters: Any, pictures: jax.Array, numbers: jax.Array) -> jax.Array:
    """Returns the actions of a policy by its arrays, for pictures, uint8 `[N, ...]`, and numbers `[N, numbers]`."""
    mean, std, eyes = parameters
    return look(eyes, pictures.astype(jnp.float32) / 255.0, (numbers - mean) / std)[0]

"""The mean action of a trained policy, as a plain NumPy function that is free of JAX."""

import dataclasses
import itertools
from typing import Any

import numpy as np

from hgail_envs.randomization import Randomization

MAX_NORMALIZED = 5.0
"""Largest absolute normalised observation; beyond it observations are clipped."""
NORM_EPSILON = 1e-6
"""Of layer normalisation, as flax has it."""


@dataclasses.dataclass(frozen=True)
class MeanPolicy:
    """The mean action of a trained policy, free of JAX; a ValueError if its arrays do not fit or are not finite."""

    task: str
    goal_size: int
    """Size of the desired goal, the last numbers of an observation."""
    mean: np.ndarray = dataclasses.field(repr=False)
    """Mean of the observations, `[observation_size]`, for normalisation."""
    std: np.ndarray = dataclasses.field(repr=False)
    """Their standard deviation, `[observation_size]`."""
    layers: tuple[tuple[np.ndarray, ...], ...] = dataclasses.field(repr=False)
    """Weights `[inputs, outputs]` and biases `[outputs]`, and, of hidden layers with layer normalisation, its scale and
    offset `[outputs]`. After those stands ReLU, after the others tanh; after the last neither."""
    versions: dict[str, str | None] = dataclasses.field(default_factory=dict)
    """Versions of the packages that trained it."""
    randomization: Randomization = Randomization()  # noqa: RUF009  (frozen)
    """Randomisation of its training episodes."""
    task_options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the task's class that it was trained with, e.g. `observation`."""

    squash: bool = False
    """Whether tanh brings the last layer's outputs into [-1, 1]; else they are clipped."""

    def __post_init__(self) -> None:
        arrays = [self.mean, self.std, *(array for layer in self.layers for array in layer)]
        if not all(array.dtype == np.float32 and np.isfinite(array).all() for array in arrays):
            raise ValueError("not all of its arrays are finite float32 numbers")
        if not (0 < self.goal_size < self.mean.size and self.mean.shape == self.std.shape and (self.std > 0).all()):
            raise ValueError("its normalisation does not fit its observation")
        sizes = [self.mean.shape, *(layer[1].shape for layer in self.layers)]
        shapes = [before + after for before, after in itertools.pairwise(sizes)]
        fit = [
            len(shape) == 2 and weights.shape == shape and all(array.shape == biases.shape for array in norm)
            for shape, (weights, biases, *norm) in zip(shapes, self.layers, strict=True)
        ]
        if not (fit and all(fit)):
            raise ValueError("its layers do not fit together")

    @property
    def observation_size(self) -> int:
        """Numbers in an observation: features, then the desired goal."""
        return self.mean.size

    @property
    def action_size(self) -> int:
        """Numbers in an action."""
        return self.layers[-1][1].size

    def __call__(self, observation: np.ndarray, xp: Any = np) -> np.ndarray:
        """Returns actions in [-1, 1], `[..., action_size]`, for observations `[..., observation_size]`, as they are.

        The module `xp` computes, `numpy` or `jax.numpy`. A ValueError says that the last axis has another size.
        """
        if np.shape(observation)[-1:] != self.mean.shape:
            raise ValueError(f"an observation of {self.task} has {self.observation_size} numbers")
        return mean_action(self.mean, self.std, self.layers, self.squash, observation, xp)


def mean_action(mean: Any, std: Any, layers: Any, squash: bool, observation: Any, xp: Any = np) -> Any:
    """Returns the action of `MeanPolicy` from its arrays, which JAX may trace or batch."""
    hidden = xp.clip((observation - mean) / std, -MAX_NORMALIZED, MAX_NORMALIZED)
    for weights, biases, *norm in layers[:-1]:
        hidden = hidden @ weights + biases
        if norm:
            scale, offset = norm
            centred = hidden - hidden.mean(axis=-1, keepdims=True)
            variance = xp.square(centred).mean(axis=-1, keepdims=True)
            hidden = xp.maximum(centred / xp.sqrt(variance + NORM_EPSILON) * scale + offset, 0.0)
        else:
            hidden = xp.tanh(hidden)
    weights, biases = layers[-1]
    action = hidden @ weights + biases
    return xp.tanh(action) if squash else xp.clip(action, -1.0, 1.0)

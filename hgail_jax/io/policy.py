"""A trained policy as a file, and as a plain NumPy function.

The file is an npz of float32 arrays, not compressed, with a header in JSON; NumPy alone reads it and nothing in it is
code. Layer `i` is `weights_i` and `biases_i`, `mean` and `std` normalise the observation, and the header is

    {"format": "hgail_jax policy 2", "task": "reach",
     "observation": {"features": 6, "goal": 3, "clip": 5.0},   # features first, then the goal; clipped once normalised
     "action": {"size": 4, "low": -1.0, "high": 1.0},          # the mean action is clipped to this
     "layers": 3, "activation": "tanh", "squash": false,       # between the layers; whether tanh stands after the last
     "randomization": {},                                      # of its training: fields of `Randomization`
     "task_options": {},                                       # of the task's class, in training
     "versions": {"hgail-jax": "0.1.0", "jax": "0.10.2"}}

Where `randomization` has a `known_delay`, the features begin with so many actions on their way, each after a 1; then
come, where it has a `history`, so many actions and observations. See `RandomizedEnv`.
"""

import dataclasses
import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hgail_envs import GoalEnv
from hgail_envs.randomization import Randomization
from hgail_jax.config import Config
from hgail_jax.io.files import replace_file
from hgail_jax.io.npz import load_npz
from hgail_jax.io.provenance import installed
from hgail_jax.learners import find_learner
from hgail_jax.state import MAX_NORMALIZED, TrainState

_FORMAT = "hgail_jax policy 2"
_ACTION = {"low": -1.0, "high": 1.0}
_TANH, _LAYER_NORM_RELU = "tanh", "layer-norm-relu"
_ARRAYS = ("weights", "biases", "scale", "offset")  # of a layer
NORM_EPSILON = 1e-6
"""Of layer normalisation, as flax has it."""


@dataclasses.dataclass(frozen=True)
class MeanPolicy:
    """The mean action of a trained policy, free of JAX.

    Raises:
      ValueError: the sizes of the arrays do not fit together, or a number is not finite.

    """

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
        """Returns actions in [-1, 1], `[..., action_size]`, for observations `[..., observation_size]`.

        Args:
          observation: not normalised.
          xp: the module that computes, `numpy` or `jax.numpy`.

        Raises:
          ValueError: the last axis of the observations has another size.

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
    return xp.tanh(action) if squash else xp.clip(action, _ACTION["low"], _ACTION["high"])


def from_state(
    task: str, env: GoalEnv, config: Config, state: TrainState, task_options: Mapping[str, Any] | None = None
) -> MeanPolicy:
    """Takes the policy out of the state of one seed, trained on `env`, which `task` and its options name."""
    learner = find_learner(config)
    return MeanPolicy(
        task=task,
        goal_size=env.goal_size,
        mean=np.asarray(state.statistics.mean),
        std=np.asarray(state.statistics.std),
        layers=tuple(tuple(map(np.asarray, layer)) for layer in learner.layers(state)),
        squash=learner.squashes,
        versions=installed("hgail-jax", "jax", "mujoco-mjx"),
        randomization=getattr(env, "randomization", Randomization()),
        task_options=dict(task_options or {}),
    )


def save_policy(path: Path | str, policy: MeanPolicy) -> None:
    """Writes a policy; see the module for the format."""
    header = {
        "format": _FORMAT,
        "task": policy.task,
        "observation": {
            "features": policy.observation_size - policy.goal_size,
            "goal": policy.goal_size,
            "clip": MAX_NORMALIZED,
        },
        "action": {"size": policy.action_size, **_ACTION},
        "layers": len(policy.layers),
        "activation": _LAYER_NORM_RELU if len(policy.layers[0]) > 2 else _TANH,
        "squash": policy.squash,
        "randomization": {} if policy.randomization == Randomization() else policy.randomization.as_dict(),
        "task_options": policy.task_options,
        "versions": policy.versions,
    }
    arrays = {"mean": policy.mean, "std": policy.std}
    for index, layer in enumerate(policy.layers):
        arrays |= {f"{name}_{index}": array for name, array in zip(_ARRAYS, layer, strict=False)}
    with replace_file(path, "wb") as file:
        np.savez(file, **arrays, header=np.array(json.dumps(header)))  # type: ignore[arg-type]


def load_policy(path: Path | str) -> MeanPolicy:
    """Reads a policy written by `save_policy`; the file need not be trusted.

    Raises:
      FileNotFoundError: there is no such file.
      ValueError: the file is not a policy.

    """
    return load_npz(path, "a policy", _from_file)


def _from_file(file: Mapping[str, np.ndarray]) -> MeanPolicy:
    header = json.loads(str(file["header"]))
    if header["format"] != _FORMAT:
        raise ValueError(f"its format is {header['format']!r}, not {_FORMAT!r}")
    if not (isinstance(header.get("task"), str) and header["task"]):
        raise ValueError("it names no task")
    observation, action = header["observation"], header["action"]
    computes = (header["activation"], observation["clip"], action["low"], action["high"])
    if computes not in [(known, MAX_NORMALIZED, *_ACTION.values()) for known in (_TANH, _LAYER_NORM_RELU)]:
        raise ValueError(f"this version does not compute {computes}")
    count, plain = header["layers"], header["activation"] == _TANH
    if not 0 < count <= len(file):
        raise ValueError(f"it has no {count} layers")
    layers = tuple(
        tuple(file[f"{name}_{index}"] for name in (_ARRAYS[:2] if index + 1 == count or plain else _ARRAYS))
        for index in range(count)
    )
    policy = MeanPolicy(
        header["task"],
        observation["goal"],
        file["mean"],
        file["std"],
        layers,
        dict(header["versions"]),
        Randomization.from_json(header.get("randomization", {})),  # older files have none
        dict(header.get("task_options", {})),  # nor these
        bool(header.get("squash", False)),
    )
    if (policy.observation_size, policy.action_size) != (observation["features"] + observation["goal"], action["size"]):
        raise ValueError("its arrays do not have the sizes that its header names")
    return policy

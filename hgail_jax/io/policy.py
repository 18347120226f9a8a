"""A trained policy as a file.

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
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hgail_envs import GoalEnv
from hgail_envs.randomization import Randomization
from hgail_jax.config import Config
from hgail_jax.io.files import load_npz, save_npz
from hgail_jax.io.provenance import installed
from hgail_jax.policy import MAX_NORMALIZED, MeanPolicy
from hgail_jax.state import TrainState

_FORMAT = "hgail_jax policy 2"
_ACTION = {"low": -1.0, "high": 1.0}
_TANH, _LAYER_NORM_RELU = "tanh", "layer-norm-relu"
_ARRAYS = ("weights", "biases", "scale", "offset")  # of a layer


def from_state(
    task: str, env: GoalEnv, config: Config, state: TrainState, task_options: Mapping[str, Any] | None = None
) -> MeanPolicy:
    """Takes the policy out of the state of one seed, trained on `env`, which `task` and its options name."""
    return MeanPolicy(
        task=task,
        goal_size=env.goal_size,
        mean=np.asarray(state.statistics.mean),
        std=np.asarray(state.statistics.std),
        layers=tuple(tuple(map(np.asarray, layer)) for layer in config.learner.layers(state)),
        squash=config.learner.squashes,
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
        "randomization": {} if policy.randomization == Randomization() else dataclasses.asdict(policy.randomization),
        "task_options": policy.task_options,
        "versions": policy.versions,
    }
    arrays = {"mean": policy.mean, "std": policy.std}
    for index, layer in enumerate(policy.layers):
        arrays |= {f"{name}_{index}": array for name, array in zip(_ARRAYS, layer, strict=False)}
    save_npz(path, header, arrays)


def load_policy(path: Path | str) -> MeanPolicy:
    """Reads a policy written by `save_policy`; the file need not be trusted.

    Raises:
      FileNotFoundError: there is no such file.
      ValueError: the file is not a policy.
    """
    return load_npz(path, "a policy", _FORMAT, _from_file)


def _from_file(header: dict, file: Mapping[str, np.ndarray]) -> MeanPolicy:
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

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

A policy that sees pictures has another format:

    {"format": "hgail_jax camera policy 1", "task": "push",
     "pictures": {"cameras": ["front", "side"], "size": 64, "colours": "RGB", "range": [0, 255]},
                                                               # of depth "kind": "depth", "metres": [0.0, 1.6] for
                                                               # "colours": distances that are 0 and 255
     "numbers": {"size": 10, "goal": 4},                       # its numbers: `KNOWN` features, then the goal;
                                                               # no goal where it sees the target in the pictures
     "action": {"size": 4, "low": -1.0, "high": 1.0}, "convolutions": 4, "layers": 2, "look": "varied",
     "look_sizes": {"scene": {}, "image": {}},                 # fields of `Look` and `Augmentation`
     "task_options": {}, "versions": {}}

with `kernel_i`, `kernel_biases_i` of its convolutions, layers as above, `action_weights`, `action_biases`, and
`objects_weights`, `objects_biases` and `centre` for the positions of the objects.

Where `randomization` has a `known_delay`, the features begin with so many actions on their way, each after a 1; then
come, where it has a `history`, so many actions and observations. See `RandomizedEnv`.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hgail_envs import GoalEnv
from hgail_envs.randomization import Randomization
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.depth import FAR
from hgail_jax.config import Config
from hgail_jax.io.files import load_npz, save_npz
from hgail_jax.io.provenance import installed
from hgail_jax.policy import MAX_NORMALIZED, MeanPolicy
from hgail_jax.state import TrainState
from hgail_jax.vision.network import Eyes
from hgail_jax.vision.policy import CameraPolicy, sizes_of_look

_FORMAT, _CAMERA_FORMAT = "hgail_jax policy 2", "hgail_jax camera policy 1"
_ACTION = {"low": -1.0, "high": 1.0}
_TANH, _LAYER_NORM_RELU = "tanh", "layer-norm-relu"
_PICTURES: dict[str, dict[str, Any]] = {
    "colour": {"colours": "RGB", "range": [0, 255]},
    "depth": {"kind": "depth", "range": [0, 255], "metres": [0.0, FAR]},
}
_ARRAYS = ("weights", "biases", "scale", "offset")  # of a layer
_KERNEL = ("kernel", "kernel_biases")  # of a convolution
_HEADS = ("action", "objects")


AnyPolicy = MeanPolicy | CameraPolicy
"""A trained policy of either kind."""


def from_state(
    task: str, env: GoalEnv, config: Config, state: TrainState, task_options: Mapping[str, Any] | None = None
) -> AnyPolicy:
    """Takes the policy out of the state of one seed, trained on `env`, which `task` and its options name."""
    versions = installed("hgail-jax", "jax", "mujoco-mjx")
    if isinstance(env, CameraEnv):
        return CameraPolicy(
            task=task,
            goal_size=env.goal_size if env.pictures.target == "given" else 0,
            cameras=env.pictures.cameras,
            size=env.pictures.size,
            **jax.tree.map(np.asarray, config.learner.camera_policy(env, state)),
            versions=versions,
            task_options=dict(task_options or {}),
            look=env.pictures.look,
            look_sizes=sizes_of_look(env.pictures.look, env.pictures.kind),
            kind=env.pictures.kind,
        )
    return MeanPolicy(
        task=task,
        goal_size=env.goal_size,
        mean=np.asarray(state.statistics.mean),
        std=np.asarray(state.statistics.std),
        layers=tuple(tuple(map(np.asarray, layer)) for layer in config.learner.layers(state)),
        squash=config.learner.squashes,
        versions=versions,
        randomization=getattr(env, "randomization", Randomization()),
        task_options=dict(task_options or {}),
    )


def save_policy(path: Path | str, policy: AnyPolicy) -> None:
    """Writes a policy; see the module for the format."""
    if isinstance(policy, CameraPolicy):
        _save_camera_policy(path, policy)
        return
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


def _save_camera_policy(path: Path | str, policy: CameraPolicy) -> None:
    eyes = policy.eyes
    header = {
        "format": _CAMERA_FORMAT,
        "task": policy.task,
        "pictures": {"cameras": list(policy.cameras), "size": policy.size, **_PICTURES[policy.kind]},
        "numbers": {"size": policy.mean.size, "goal": policy.goal_size},
        "action": {"size": policy.action_size, **_ACTION},
        "convolutions": len(eyes.convolutions),
        "layers": len(eyes.hidden),
        "look": policy.look,
        "look_sizes": policy.look_sizes,
        "task_options": policy.task_options,
        "versions": policy.versions,
    }
    arrays = {"mean": policy.mean, "std": policy.std, "centre": policy.centre}
    for names, layers in ((_KERNEL, eyes.convolutions), (_ARRAYS, eyes.hidden)):
        for index, layer in enumerate(layers):
            arrays |= {f"{name}_{index}": array for name, array in zip(names, layer, strict=True)}
    for head in _HEADS:
        arrays |= {f"{head}_{name}": array for name, array in zip(_ARRAYS[:2], getattr(eyes, head), strict=True)}
    save_npz(path, header, arrays)


def _camera_policy_from_file(header: dict, file: Mapping[str, np.ndarray]) -> CameraPolicy:
    pictures, numbers, action = header["pictures"], header["numbers"], header["action"]
    kind = pictures.get("kind", "colour")
    known = kind in _PICTURES and _PICTURES[kind].items() <= pictures.items() and _ACTION.items() <= action.items()
    if not known:
        raise ValueError(f"this version does not compute {pictures}, {action}")

    def layers(names: tuple[str, ...], count: int) -> list[tuple[np.ndarray, ...]]:
        if not 0 < count <= len(file):
            raise ValueError(f"it has no {count} layers")
        return [tuple(file[f"{name}_{index}"] for name in names) for index in range(count)]

    heads = [tuple(file[f"{head}_{name}"] for name in _ARRAYS[:2]) for head in _HEADS]
    policy = CameraPolicy(
        task=header["task"],
        goal_size=numbers["goal"],
        cameras=tuple(pictures["cameras"]),
        size=pictures["size"],
        mean=file["mean"],
        std=file["std"],
        centre=file["centre"],
        eyes=Eyes(layers(_KERNEL, header["convolutions"]), layers(_ARRAYS, header["layers"]), *heads),
        versions=dict(header["versions"]),
        task_options=dict(header["task_options"]),
        look=str(header["look"]),
        look_sizes=dict(header.get("look_sizes", {})),  # older files have none
        kind=kind,
    )
    if (policy.mean.size, policy.action_size) != (numbers["size"], action["size"]):
        raise ValueError("its arrays do not have the sizes that its header names")
    return policy


def load_policy(path: Path | str) -> MeanPolicy:
    """Reads a policy that sees positions; see `load_any_policy`. A ValueError if it sees pictures."""
    policy = load_any_policy(path)
    if isinstance(policy, CameraPolicy):
        raise ValueError(f"{path} sees pictures; here a policy is given positions")
    return policy


def load_any_policy(path: Path | str) -> AnyPolicy:
    """Reads a policy written by `save_policy`; the file need not be trusted.

    Raises:
      FileNotFoundError: there is no such file.
      ValueError: the file is not a policy.
    """
    formats: dict[str, Any] = {_FORMAT: _from_file, _CAMERA_FORMAT: _camera_policy_from_file}
    policy: AnyPolicy = load_npz(path, "a policy", formats)
    return policy


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

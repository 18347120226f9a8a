"""A trained policy as a file, and as a plain NumPy function."""

import dataclasses
import json
from pathlib import Path

import numpy as np

from hgail_jax.files import replace_file

_FORMAT = "hgail_jax policy 1"
_CLIP = 5.0


@dataclasses.dataclass(frozen=True)
class MeanPolicy:
    """The mean action of a trained policy, free of JAX."""

    task: str
    mean: np.ndarray
    """`[observation_size]`: what is taken off an observation."""
    std: np.ndarray
    """`[observation_size]`: what it is then divided by."""
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    """Weights `[inputs, outputs]` and biases `[outputs]`; tanh stands between the layers."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Returns actions in [-1, 1], `[..., action_size]`, for observations `[..., observation_size]`."""
        hidden = np.clip((observation - self.mean) / self.std, -_CLIP, _CLIP)
        for weights, biases in self.layers[:-1]:
            hidden = np.tanh(hidden @ weights + biases)
        weights, biases = self.layers[-1]
        return np.clip(hidden @ weights + biases, -1.0, 1.0)


def from_state(task: str, state) -> MeanPolicy:
    """Takes the policy out of a `TrainState` of one seed."""
    dense = state.actor_critic["policy"]["params"]
    layers = [dense[f"Dense_{index}"] for index in range(len(dense))]
    return MeanPolicy(
        task=task,
        mean=np.asarray(state.statistics.mean),
        std=np.asarray(state.statistics.std),
        layers=tuple((np.asarray(layer["kernel"]), np.asarray(layer["bias"])) for layer in layers),
    )


def save_policy(path: Path | str, policy: MeanPolicy) -> None:
    """Writes a policy as an npz of float32 arrays and a JSON header; nothing in it is code."""
    header = {"format": _FORMAT, "task": policy.task, "layers": len(policy.layers)}
    arrays = {"mean": policy.mean, "std": policy.std}
    for index, (weights, biases) in enumerate(policy.layers):
        arrays |= {f"weights_{index}": weights, f"biases_{index}": biases}
    with replace_file(path, "wb") as file:
        np.savez(file, **arrays, header=np.array(json.dumps(header)))  # type: ignore[arg-type]


def load_policy(path: Path | str) -> MeanPolicy:
    """Reads a policy written by `save_policy`.

    Raises:
      ValueError: the file is not one.

    """
    try:
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            if header["format"] != _FORMAT:
                raise ValueError(f"its format is {header['format']!r}, not {_FORMAT!r}")
            layers = tuple((file[f"weights_{i}"], file[f"biases_{i}"]) for i in range(header["layers"]))
            return MeanPolicy(header["task"], file["mean"], file["std"], layers)
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(f"{path} is not a policy file: {error}") from error

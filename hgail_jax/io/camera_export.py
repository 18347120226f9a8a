"""A policy that sees pictures as an ONNX or StableHLO program, for runtimes that are not Python."""

from pathlib import Path
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from hgail_envs.layout import FRAMES
from hgail_envs.quantities import describe
from hgail_envs.registry import make
from hgail_envs.vision.camera_env import KNOWN
from hgail_envs.vision.cameras import camera_ids, describe_cameras
from hgail_envs.vision.depth import FAR
from hgail_jax.io.export import described_place, described_rows
from hgail_jax.io.files import replace_file
from hgail_jax.io.graph import FLOAT, UINT8, Graph
from hgail_jax.vision.network import STRIDES
from hgail_jax.vision.policy import CameraPolicy, act

_PIXEL: dict[str, dict[str, Any]] = {
    "colour": {"colours": "red, green, blue"},
    "depth": {"kind": "depth: distance from the camera's plane, white where none was measured", "metres": [0.0, FAR]},
}


def export_camera_policy(path: Path | str, policy: CameraPolicy) -> None:
    """Writes the action as a portable StableHLO artifact: a function `main` with the weights in it.

    It maps pictures, uint8 `[cameras, size, size, 3]` or of depth `[cameras, size, size, 1]`, and numbers, float32
    `[numbers]`, to an action, `[action_size]`.
    """
    parameters = jax.tree.map(jnp.asarray, policy.parameters())
    given = (
        jax.ShapeDtypeStruct(policy.pictures_shape, jnp.uint8),
        jax.ShapeDtypeStruct(policy.mean.shape, jnp.float32),
    )
    one = jax.jit(lambda pictures, numbers: act(parameters, pictures[None], numbers[None])[0])
    with replace_file(path, "wb") as file:
        file.write(jax.export.export(one, platforms=("cpu",))(*given).mlir_module_serialized)


def export_camera_onnx(path: Path | str, policy: CameraPolicy, success: float | None = None) -> None:
    """Writes the action as an ONNX model with metadata that explain its pictures and numbers.

    Its inputs are a picture from each camera, by the camera's name, uint8 `[batch, size, size, 3]`, of depth
    `[batch, size, size, 1]`, and `numbers`, float32 `[batch, numbers]`; its output is `action`, `[batch, action_size]`,
    each number from -1 to 1. The metadata are those of `hgail_jax.io.export.export_onnx`, with `numbers` in place of
    `observation`, and `pictures`: size, order of colours and rows, range, of depth the metres of that range, and each
    camera's pose and intrinsics, see `hgail_envs.vision.cameras.describe_cameras`.

    Raises:
      ImportError: the extra `onnx` is not installed.
      ValueError: the task is none of this package, or the policy takes other numbers than it has.
    """
    about = _metadata(policy, success)
    inputs: dict[str, tuple[int, list[Any]]] = {
        camera: (UINT8, ["batch", *policy.pictures_shape[1:]]) for camera in policy.cameras
    }
    inputs["numbers"] = FLOAT, ["batch", policy.mean.size]
    _graph(policy).save(path, inputs, policy.action_size, about)


def _graph(policy: CameraPolicy) -> Graph:
    """Returns the graph, which follows `hgail_jax.vision.network.look`."""
    graph = Graph()
    hidden = graph.node("Concat", policy.cameras, "colours", axis=3) if len(policy.cameras) > 1 else policy.cameras[0]
    hidden = graph.node("Cast", [hidden], "cast", to=FLOAT)
    hidden = graph.node("Div", [hidden, graph.constant("range", 255.0)], "unit")
    hidden = graph.node("Sub", [hidden, graph.constant("middle", 0.5)], "grey_is_0")
    hidden = graph.node("Transpose", [hidden], "channels_first", perm=[0, 3, 1, 2])
    size = policy.size
    for index, ((kernel, biases), stride) in enumerate(zip(policy.eyes.convolutions, STRIDES, strict=True)):
        parts = [
            graph.constant(f"kernel_{index}", kernel.transpose(3, 2, 0, 1)),
            graph.constant(f"bias_{index}", biases),
        ]
        options: dict[str, Any] = {"strides": [stride, stride], "auto_pad": "SAME_UPPER"}
        hidden = graph.node("Conv", [hidden, *parts], f"convolution_{index}", **options)
        hidden = graph.node("Relu", [hidden], f"features_{index}")
        size = -(-size // stride)
    hidden = _places(graph, hidden, size, policy.eyes.convolutions[-1][1].size)
    numbers = graph.node("Sub", ["numbers", graph.constant("mean", policy.mean)], "centred")
    numbers = graph.node("Div", [numbers, graph.constant("std", policy.std)], "normalized")
    hidden = graph.node("Concat", [hidden, numbers], "seen", axis=1)
    for index, layer in enumerate(policy.eyes.hidden):
        hidden = graph.hidden(hidden, layer, str(index))
    graph.node("Tanh", [graph.linear(hidden, policy.eyes.action, "action")], "action")
    return graph


def _places(graph: Graph, features: str, size: int, channels: int) -> str:
    """Adds the mean place of each feature in the picture: `[batch, C, size, size]` to `[batch, 2 C]`."""
    flat = graph.node("Reshape", [features, graph.constant("flat", [0, channels, size * size], np.int64)], "pixels")
    weights = graph.node("Softmax", [flat], "pixel_weights", axis=2)
    rows, columns = np.meshgrid(*[np.linspace(-1.0, 1.0, size)] * 2, indexing="ij")
    grid = graph.constant("grid", np.stack([rows.ravel(), columns.ravel()], axis=1))
    places = graph.node("MatMul", [weights, grid], "y_and_x")
    places = graph.node("Transpose", [places], "y_then_x", perm=[0, 2, 1])
    return graph.node("Reshape", [places, graph.constant("in_a_row", [0, 2 * channels], np.int64)], "places")


def _metadata(policy: CameraPolicy, success: float | None) -> dict[str, Any]:
    env = make(policy.task, **policy.task_options)
    described = describe(policy.task, 0, 0, (), **policy.task_options)
    features = [row for row in described_rows(described.features) if row["name"] in _names(described.features)]
    of_goal = described_rows(described.observation)[described.features.size :]
    rows = [*features, *(of_goal if policy.target == "given" else [])]
    if len(rows) != policy.mean.size:
        raise ValueError(f"the policy takes {policy.mean.size} numbers, which are not those of {policy.task}")
    numbers = [
        {**row, "index": index, "mean": float(mean), "std": float(std)}
        for index, (row, mean, std) in enumerate(zip(rows, policy.mean, policy.std, strict=True))
    ]
    model = env.robot.load(visual=True)
    camera_ids(model, env.robot.scene, policy.cameras)
    return {
        "task": policy.task,
        "pictures": {
            "cameras": describe_cameras(model, policy.cameras, policy.size),
            "size": policy.size,
            **_PIXEL[policy.kind],
            "rows": "the upper first",
            "range": [0, 255],
        },
        "numbers": numbers,
        "goal": numbers[len(numbers) - policy.goal_size :],
        "target": policy.target,
        "action": [{**row, "low": -1.0, "high": 1.0} for row in described_rows(described.action)],
        "frames": FRAMES,
        **described_place(env),
        "normalization": "in the graph: pictures by 255, numbers less mean by standard deviation",
        "look": policy.look,
        "task_options": policy.task_options,
        "versions": policy.versions,
        **({} if success is None else {"success": success}),
    }


def _names(features: Any) -> set[str]:
    """Returns the names of the numbers that a policy with pictures takes."""
    return {number.title for quantity in features if quantity.title in KNOWN for number in quantity.numbers}

"""Builds an ONNX model node by node; the package `onnx` is imported at first use, for it is an extra."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hgail_jax.io.files import replace_file
from hgail_jax.io.provenance import installed
from hgail_jax.policy import NORM_EPSILON

OPSET, IR_VERSION = 17, 8
"""Versions of ONNX that onnxruntime 1.17 of 2024 loads, as do all later ones."""
FLOAT, UINT8 = 1, 2
"""ONNX's numbers of element types."""


class Graph:
    """Nodes and constants of a model, in the order in which they are computed."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def constant(self, name: str, value: Any, dtype: Any = np.float32) -> str:
        """Adds a constant and returns its name."""
        from onnx import numpy_helper

        self._constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def node(self, kind: str, inputs: Sequence[str], output: str, **attributes: Any) -> str:
        """Adds an operation and returns the name of its output."""
        from onnx import helper

        self._nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def linear(self, hidden: str, layer: Sequence[np.ndarray], name: str) -> str:
        """Adds a layer's matrix product and biases."""
        parts = [self.constant(f"weights_{name}", layer[0]), self.constant(f"biases_{name}", layer[1])]
        return self.node("Gemm", [hidden, *parts], f"linear_{name}")

    def hidden(self, hidden: str, layer: Sequence[np.ndarray], name: str) -> str:
        """Adds a hidden layer: ReLU after layer normalisation where it has one, else tanh."""
        hidden = self.linear(hidden, layer, name)
        if not layer[2:]:
            return self.node("Tanh", [hidden], f"hidden_{name}")
        parts = [self.constant(f"scale_{name}", layer[2]), self.constant(f"offset_{name}", layer[3])]
        hidden = self.node("LayerNormalization", [hidden, *parts], f"norm_{name}", axis=-1, epsilon=NORM_EPSILON)
        return self.node("Relu", [hidden], f"hidden_{name}")

    def save(
        self, path: Path | str, inputs: Mapping[str, tuple[int, list[Any]]], action_size: int, about: dict[str, Any]
    ) -> None:
        """Writes the model, whose output is the node `action`.

        The inputs are element types and shapes by name, with text for axes of any size; `about` are the metadata.
        """
        from onnx import checker, helper

        graph = helper.make_graph(
            self._nodes,
            "policy",
            [helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in inputs.items()],
            [helper.make_tensor_value_info("action", FLOAT, ["batch", action_size])],
            self._constants,
            doc_string=f"Mean action of a policy for the task {about['task']}; the metadata describe each number.",
        )
        model = helper.make_model(
            graph,
            producer_name="hgail-jax",
            producer_version=installed("hgail-jax")["hgail-jax"] or "",
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
        )
        helper.set_model_props(model, {name: json.dumps(value) for name, value in about.items()})
        checker.check_model(model, full_check=True)
        with replace_file(path, "wb") as file:
            file.write(model.SerializeToString())

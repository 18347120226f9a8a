"""A trained policy as an ONNX or StableHLO program, for runtimes that are not Python."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from hgail_envs.layout import FRAMES, Layout
from hgail_envs.quantities import Description, describe
from hgail_envs.registry import TASKS, make
from hgail_envs.robots.base import TOP_SPEED
from hgail_envs.scenes import TABLE_HEIGHT
from hgail_envs.tasks.arm import ArmEnv
from hgail_jax.io.files import replace_file
from hgail_jax.io.provenance import installed
from hgail_jax.policy import MAX_NORMALIZED, NORM_EPSILON, MeanPolicy

OPSET, IR_VERSION = 17, 8
"""Versions of ONNX that onnxruntime 1.17 of 2024 loads, as do all later ones."""


def export_policy(path: Path | str, policy: MeanPolicy) -> None:
    """Writes the mean action as a portable StableHLO artifact: a function `main` with the weights in it.

    It maps one observation, float32 `[observation_size]`, to one action, `[action_size]`, and calls nothing but
    StableHLO's own operations, so that any compiler of StableHLO runs it.
    """
    observation = jax.ShapeDtypeStruct((policy.observation_size,), jnp.float32)
    exported = jax.export.export(jax.jit(lambda seen: policy(seen, xp=jnp)), platforms=("cpu",))(observation)
    with replace_file(path, "wb") as file:
        file.write(exported.mlir_module_serialized)


def export_onnx(path: Path | str, policy: MeanPolicy, success: float | None = None, trusted: bool = False) -> None:
    """Writes the mean action as an ONNX model, normalisation included, with metadata that explain its numbers.

    It maps `observation`, float32 `[batch, observation_size]`, to `action`, `[batch, action_size]`, each number from -1
    to 1. The metadata, `metadata_props`, are JSON: `task`, `observation`, `goal` and `action` (index, name, unit and
    frame of each number, and mean and standard deviation in training), `frames`, `control_period` in seconds, of tasks
    of an arm the `robot`, metres of the scene to one of the robot (`scale`), its gripper's `start`, `table_height` and
    `lowest_height`, in the scene's metres, and the `top_speed` of a unit action, m/s there, `known_delay`, `history`,
    `randomization` and `task_options` of the training, `versions` and, if it is known, the rate of `success`.

    Only if `trusted` is the class of a task imported that is not of this package, to name its numbers.

    Raises:
      ImportError: the extra `onnx` is not installed.
      ValueError: the policy reads other numbers than its task has.
    """
    from onnx import checker, helper  # here, so that the module imports without the extra

    nodes, constants = _operations(policy)
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", 1, ["batch", policy.observation_size])],  # 1 is float32
        [helper.make_tensor_value_info("action", 1, ["batch", policy.action_size])],
        constants,
        doc_string=f"Mean action of a policy for the task {policy.task}; the metadata describe each number.",
    )
    model = helper.make_model(
        graph,
        producer_name="hgail-jax",
        producer_version=installed("hgail-jax")["hgail-jax"] or "",
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )
    helper.set_model_props(
        model, {name: json.dumps(value) for name, value in _metadata(policy, success, trusted).items()}
    )
    checker.check_model(model, full_check=True)
    with replace_file(path, "wb") as file:
        file.write(model.SerializeToString())


def _operations(policy: MeanPolicy) -> tuple[list[Any], list[Any]]:
    """Returns the nodes and the constants of the graph; they follow `hgail_jax.policy.mean_action`."""
    from onnx import helper, numpy_helper

    constants: list[Any] = []
    nodes: list[Any] = []

    def constant(name: str, value: Any) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value, np.float32), name))
        return name

    def node(kind: str, inputs: list[str], output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    hidden = node("Sub", ["observation", constant("mean", policy.mean)], "centred")
    hidden = node("Div", [hidden, constant("std", policy.std)], "scaled")
    limits = [constant("least", -MAX_NORMALIZED), constant("most", MAX_NORMALIZED)]
    hidden = node("Clip", [hidden, *limits], "normalized")
    last = len(policy.layers) - 1
    for index, (weights, biases, *norm) in enumerate(policy.layers):
        parts = [constant(f"weights_{index}", weights), constant(f"biases_{index}", biases)]
        hidden = node("Gemm", [hidden, *parts], f"linear_{index}")
        if norm:
            parts = [constant(f"scale_{index}", norm[0]), constant(f"offset_{index}", norm[1])]
            hidden = node("LayerNormalization", [hidden, *parts], f"norm_{index}", axis=-1, epsilon=NORM_EPSILON)
            hidden = node("Relu", [hidden], f"hidden_{index}")
        elif index < last:
            hidden = node("Tanh", [hidden], f"hidden_{index}")
    if policy.squash:
        node("Tanh", [hidden], "action")
    else:
        node("Clip", [hidden, constant("low", -1.0), constant("high", 1.0)], "action")
    return nodes, constants


def check_described(policy: MeanPolicy, trusted: bool = False) -> Description:
    """Returns the description of the numbers that a policy reads and commands, if it reads those of its task.

    Unless `trusted`, the class of a task that is not of this package is not imported, and its numbers are numbered.
    """
    history, known = policy.randomization.history, policy.randomization.known_delay
    past = policy.action_size * history + (1 + policy.action_size) * known
    sizes = ((policy.observation_size - policy.goal_size - past) // (1 + history), policy.goal_size, policy.action_size)
    of_class = trusted or policy.task in TASKS
    described = describe(policy.task, history, known, () if of_class else sizes, **policy.task_options)
    if described.observation.size != policy.observation_size:
        raise ValueError(
            f"the policy reads {policy.observation_size} numbers, which is no observation of {policy.task}"
        )
    return described


def _metadata(policy: MeanPolicy, success: float | None, trusted: bool) -> dict[str, Any]:
    described = check_described(policy, trusted)
    of_class = trusted or policy.task in TASKS  # code that only the file chose is not run
    env = make(policy.task, **policy.task_options) if of_class else None
    place = {} if env is None else {"control_period": env.control_period}
    if isinstance(env, ArmEnv):
        place |= {
            "robot": env.robot.name,
            "scale": env.robot.scale,
            "start": env.initial_gripper_position.tolist(),
            "table_height": TABLE_HEIGHT,
            "lowest_height": float(env.robot.lowest_height),
            "top_speed": TOP_SPEED,
        }
    seen = [
        {**row, "mean": float(mean), "std": float(std)}
        for row, mean, std in zip(_rows(described.observation), policy.mean, policy.std, strict=True)
    ]
    return {
        "task": policy.task,
        "observation": seen,
        "goal": seen[described.features.size :],
        "action": [{**row, "low": -1.0, "high": 1.0} for row in _rows(described.action)],
        "frames": FRAMES,
        **place,
        "normalization": f"in the graph: less mean, by standard deviation, clipped to ±{MAX_NORMALIZED:g}",
        "known_delay": policy.randomization.known_delay,
        "history": policy.randomization.history,
        "randomization": dataclasses.asdict(policy.randomization),
        "task_options": policy.task_options,
        "versions": policy.versions,
        **({} if success is None else {"success": success}),
    }


def _rows(layout: Layout) -> list[dict[str, Any]]:
    return [
        {"index": index, "name": number.title, "unit": number.unit, "frame": number.frame}
        for index, number in enumerate(layout.numbers)
    ]

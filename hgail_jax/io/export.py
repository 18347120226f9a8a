"""A trained policy as an ONNX or StableHLO program, for runtimes that are not Python."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.export
import jax.numpy as jnp

from hgail_envs import GoalEnv
from hgail_envs.layout import FRAMES, Layout
from hgail_envs.quantities import Description, describe
from hgail_envs.registry import TASKS, make
from hgail_envs.robots.base import TOP_SPEED
from hgail_envs.scenes import TABLE_HEIGHT
from hgail_envs.tasks.base import ArmEnv
from hgail_jax.io.files import replace_file
from hgail_jax.io.graph import FLOAT, Graph
from hgail_jax.policy import MAX_NORMALIZED, MeanPolicy


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
    about = _metadata(policy, success, trusted)
    _graph(policy).save(path, {"observation": (FLOAT, ["batch", policy.observation_size])}, policy.action_size, about)


def _graph(policy: MeanPolicy) -> Graph:
    """Returns the graph, which follows `hgail_jax.policy.mean_action`."""
    graph = Graph()
    hidden = graph.node("Sub", ["observation", graph.constant("mean", policy.mean)], "centred")
    hidden = graph.node("Div", [hidden, graph.constant("std", policy.std)], "scaled")
    limits = [graph.constant("least", -MAX_NORMALIZED), graph.constant("most", MAX_NORMALIZED)]
    hidden = graph.node("Clip", [hidden, *limits], "normalized")
    *inner, last = policy.layers
    for index, layer in enumerate(inner):
        hidden = graph.hidden(hidden, layer, str(index))
    hidden = graph.linear(hidden, last, str(len(inner)))
    if policy.squash:
        graph.node("Tanh", [hidden], "action")
    else:
        graph.node("Clip", [hidden, graph.constant("low", -1.0), graph.constant("high", 1.0)], "action")
    return graph


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
    place = described_place(make(policy.task, **policy.task_options)) if of_class else {}
    seen = [
        {**row, "mean": float(mean), "std": float(std)}
        for row, mean, std in zip(described_rows(described.observation), policy.mean, policy.std, strict=True)
    ]
    return {
        "task": policy.task,
        "observation": seen,
        "goal": seen[described.features.size :],
        "action": [{**row, "low": -1.0, "high": 1.0} for row in described_rows(described.action)],
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


def described_place(env: GoalEnv) -> dict[str, Any]:
    """Returns a task's control period and, of an arm's, its robot and where that may go."""
    place: dict[str, Any] = {"control_period": env.control_period}
    if isinstance(env, ArmEnv):
        place |= {
            "robot": env.robot.name,
            "scale": env.robot.scale,
            "start": env.initial_gripper_position.tolist(),
            "table_height": TABLE_HEIGHT,
            "lowest_height": float(env.robot.lowest_height),
            "top_speed": TOP_SPEED,
        }
    return place


def described_rows(layout: Layout) -> list[dict[str, Any]]:
    """Returns index, name, unit and frame of each number of a layout."""
    return [
        {"index": index, "name": number.title, "unit": number.unit, "frame": number.frame}
        for index, number in enumerate(layout.numbers)
    ]

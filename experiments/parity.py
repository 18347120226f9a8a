"""Compares the Fetch tasks with Gymnasium-Robotics' on the same machine, and writes a table.

    python -m experiments.parity

Measured is how far the gripper is from the reference's, after one action and after an episode. `N` is the number of
moves or episodes and `T` of actions.
"""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

import hgail_envs
from hgail_envs.tasks.base import FAST_SUBSTEPS, REFERENCE_SUBSTEPS, ArmEnv, ArmPhysics
from hgail_envs.tasks.reference import make_reference
from hgail_jax.cli.command_line import fail, one_line_errors, parse, prepare_process
from hgail_jax.io.files import check_writable, write_json
from hgail_jax.io.provenance import provenance

PROGRAM = "parity"
EPISODES, STEPS = 8, 48
"""Episodes of the moves, and steps of each: 384 moves."""
DRIFTS, ACTIONS = 32, 50
"""Episodes without feedback, and actions of each."""
_NEW_TARGET, _HELD = 6, 5  # actions

_ROWS = (
    ("reach", "c", REFERENCE_SUBSTEPS),
    ("reach", "c", FAST_SUBSTEPS),
    ("reach", "jax", REFERENCE_SUBSTEPS),
    ("reach", "jax", FAST_SUBSTEPS),
    ("grasp", "c", REFERENCE_SUBSTEPS),
    ("grasp", "c", 8),
    ("push", "c", REFERENCE_SUBSTEPS),
    ("pick-and-place", "c", REFERENCE_SUBSTEPS),
    ("slide", "c", REFERENCE_SUBSTEPS),
)
_LONGER_THAN_ANY = 10_000  # steps
_NAMES = {
    "base_x": "robot0:slide0",
    "base_y": "robot0:slide1",
    "base_z": "robot0:slide2",
    "torso_lift": "robot0:torso_lift_joint",
    "right_finger": "robot0:r_gripper_finger_joint",
    "left_finger": "robot0:l_gripper_finger_joint",
    "cube": "object0:joint",
    "puck": "object0:joint",
}


@dataclasses.dataclass(frozen=True)
class Command:
    """Measures the distance of the gripper from the reference's, for each engine that runs on a CPU."""

    out: Path = Path("runs/parity/parity.json")
    """File to write."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line."""
    command = parse(Command, PROGRAM, __doc__, arguments)
    try:
        check_writable(command.out)
    except OSError as error:
        fail(PROGRAM, error, 2)
    rows = []
    for task, impl, substeps in _ROWS:
        rows.append(measure(task, impl, substeps))
        print(
            "  ".join(
                f"{name} {value:.3g}" if isinstance(value, float) else f"{value}" for name, value in rows[-1].items()
            )
        )
    command.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(command.out, {"rows": rows, "made_by": provenance()})


def measure(task: str, impl: str, substeps: int) -> dict[str, str | int | float]:
    """Returns a row of the table: errors of the gripper in one action and drifts without feedback, millimetres."""
    env = hgail_envs.make(task, impl=impl, substeps=substeps)
    reference = make_counterpart(env)
    errors = 1000 * one_step_errors(env, reference, random_moves(reference))
    drift = 1000 * open_loop_drift(env, *open_loop_ends(reference))
    return {
        "task": task,
        "reference": str(env.reference),
        "impl": impl,
        "substeps": substeps,
        "moves": len(errors),
        "one_step_median_mm": float(np.median(errors)),
        "one_step_p99_mm": float(np.percentile(errors, 99)),
        "episodes": len(drift),
        "drift_median_mm": float(np.median(drift)),
        "drift_worst_mm": float(drift.max()),
    }


def make_counterpart(env: ArmEnv) -> Any:
    """Returns the reference environment of a task, without wrappers and time limit."""
    return make_reference(str(env.reference), max_episode_steps=_LONGER_THAN_ANY).unwrapped


def joint_indices(model: mujoco.MjModel, theirs: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Returns the indices of our joints' positions, `[nq]`, and velocities, `[nv]`, in the reference."""
    qpos: list[int] = []
    qvel: list[int] = []
    for joint in range(model.njnt):
        name = model.joint(joint).name
        other = theirs.joint(_NAMES.get(name, f"robot0:{name}_joint"))
        free = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        qpos += range(int(other.qposadr[0]), int(other.qposadr[0]) + (7 if free else 1))
        qvel += range(int(other.dofadr[0]), int(other.dofadr[0]) + (6 if free else 1))
    return np.array(qpos), np.array(qvel)


def place(env: ArmEnv, reference: Any, qpos: np.ndarray, qvel: np.ndarray) -> ArmPhysics:
    """Returns the task's physics, `[N, ...]`, with the positions and velocities of `N` states of the reference."""
    of_qpos, of_qvel = joint_indices(env.model, reference.model)
    return jax.jit(jax.vmap(env.place))(np.float32(qpos[:, of_qpos]), np.float32(qvel[:, of_qvel]))


def gripper(reference: Any) -> np.ndarray:
    """Returns the position of the reference's gripper, `[3]`, metres."""
    # A step leaves the positions of one physics step before.
    mujoco.mj_kinematics(reference.model, reference.data)
    return reference.data.site("robot0:grip").xpos.copy()


class Moves(NamedTuple):
    """Actions of the reference, each with the states around it."""

    qpos: np.ndarray
    """`[N, nq]` of the reference."""
    qvel: np.ndarray
    """`[N, nv]` of the reference."""
    action: np.ndarray
    """`[N, 4]`."""
    before: np.ndarray
    """`[N, 3]`: the gripper's position, metres."""
    after: np.ndarray
    """`[N, 3]`."""


def random_moves(reference: Any, seed: int = 0) -> Moves:
    """Returns moves all over the workspace, down to the table: the hand wanders to a new target every few actions."""
    rng, rows = np.random.default_rng(seed), []
    data, start = reference.data, reference.initial_gripper_xpos
    for episode in range(EPISODES):
        reference.reset(seed=episode)
        for step in range(STEPS):
            if step % _NEW_TARGET == 0:
                target = start + rng.uniform(-0.15, 0.15, 3)
            pull = 10 * (target - gripper(reference)) * rng.uniform()
            action = np.clip(np.append(pull, 0) + rng.uniform(-0.7, 0.7, 4), -1, 1).astype(np.float32)
            before = (data.qpos.copy(), data.qvel.copy(), action, gripper(reference))
            reference.step(action)
            rows.append((*before, gripper(reference)))
    return Moves(*(np.stack(column) for column in zip(*rows, strict=True)))


def one_step_errors(env: ArmEnv, reference: Any, moves: Moves) -> np.ndarray:
    """Returns the errors of the gripper's displacements beside the reference's, `[N]`, metres."""
    physics = place(env, reference, moves.qpos, moves.qvel)
    following = _step(env)(physics, moves.action)
    ours = following.gripper_position - physics.gripper_position
    return np.linalg.norm(np.asarray(ours) - (moves.after - moves.before), axis=-1)


def open_loop_ends(reference: Any, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Returns random actions, each held so that the gripper travels, and the reference's final gripper positions.

    Actions are `[T, N, 4]`, ends `[N, 3]`, metres.
    """
    held = np.random.default_rng(seed).uniform(-1, 1, (ACTIONS // _HELD, DRIFTS, 4))
    actions, ends = np.repeat(held, _HELD, axis=0).astype(np.float32), []
    for episode in range(DRIFTS):
        reference.reset(seed=episode)
        for action in actions[:, episode]:
            reference.step(action)
        ends.append(gripper(reference))
    return actions, np.stack(ends)


def open_loop_drift(env: ArmEnv, actions: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Returns the distances from the reference's final positions after actions without feedback, `[N]`, metres."""
    step, states = _step(env), jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), len(ends)))
    physics = states.pipeline_state
    for action in actions:
        physics = step(physics, action)
    return np.linalg.norm(np.asarray(physics.gripper_position) - ends, axis=-1)


def _step(env: ArmEnv) -> Any:
    def step(physics: ArmPhysics, action: jax.Array) -> ArmPhysics:
        return env.step_physics(physics, action)

    return jax.jit(jax.vmap(step))


if __name__ == "__main__":
    with one_line_errors(PROGRAM):
        prepare_process()
        main()

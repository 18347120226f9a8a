"""A policy in a robot's control loop; the simulated UR5e stands for the robot, behind `read` and `command`.

`python -m experiments.real_robot` reaches a point, `python -m experiments.real_robot grasp` grasps a cube.
"""

import sys
from collections.abc import Callable
from typing import Any

import numpy as np

import hgail_envs
from experiments.transfer.robots import make_robot
from hgail_envs.past import Past
from hgail_envs.randomization import Randomization
from hgail_envs.scenes import assets_directory
from hgail_envs.tasks.base import CONTROL_PERIOD
from hgail_envs.tasks.layouts import GRIPPER
from hgail_envs.validation import check_name
from hgail_jax.io.policy import load_policy

STEPS, MOST_LATE = 50, 3
MOTION = 0.033  # metres by which a displacement of 1 moves the tool
MOST_SPEED = 0.25  # metres per second of the tool, as ISO 10218 has it for work beside a robot


def limited(action: np.ndarray, position: np.ndarray, workspace: np.ndarray, period: float) -> np.ndarray:
    """Returns an action, `[4]`, that stays in the workspace and below `MOST_SPEED`, or leads back at that speed."""
    action = np.clip(action, -1.0, 1.0)
    action[:3] = np.clip(action[:3], *np.clip((workspace - position) / MOTION, -1.0, 1.0))
    speed = float(np.linalg.norm(action[:3])) * MOTION / period
    action[:3] *= min(1.0, MOST_SPEED / max(speed, MOST_SPEED))
    return action


def run(
    policy: Callable[[np.ndarray], np.ndarray],
    read: Callable[[], np.ndarray | None],  # tool's position, robot's frame, metres, and the hand's numbers; None: late
    command: Callable[[np.ndarray], None],  # takes an action and returns when its period is over
    offset: np.ndarray,  # from the robot's frame to the policy's
    goal: np.ndarray,  # `[goal_size]`, its position in the robot's frame, as a camera gives it
    workspace: np.ndarray,  # lowest and highest position, `[2, 3]`, in the robot's frame
    past: Past | None = None,  # that the policy reads before the present observation
    period: float = CONTROL_PERIOD,  # seconds
) -> bool:
    """Runs an episode, and returns whether it went to its end; it stops if several observations in a row are late.

    An observation or an action that is not finite counts as late; a goal or a limit that is not is a ValueError.
    """
    goal = goal + np.pad(offset, (0, len(goal) - len(offset)))  # the position comes first
    if not (np.isfinite(goal).all() and np.isfinite(workspace).all()):
        raise ValueError("goal, offset and workspace must be finite")
    before, late, past = None, 0, past or Past(Randomization())
    for _ in range(STEPS):
        reading, action = read(), np.full(4, np.nan)
        if reading is not None and np.isfinite(reading).all():
            position, hand = reading[:3], reading[3:]
            moved = np.zeros(3) if before is None else position - before  # metres per action
            gripper = GRIPPER.join({"gripper position": position + offset, "gripper velocity": moved}, np)
            seen = np.concatenate([gripper, hand])
            action = policy(np.concatenate([past.before(seen), seen, goal]).astype(np.float32))
        if not np.isfinite(action).all():
            late, before = late + 1, None  # a difference over two periods would be twice the velocity
            command(np.zeros(4))  # stand still: the last action was for another place
            past.send(np.zeros(4))
            if late == MOST_LATE:
                return False
            continue
        late, before = 0, position
        action = limited(action, position, workspace, period)
        command(action)
        past.add(action, seen)
    return True


def main(task: str = "reach") -> None:
    """Runs the robust policy of a task, and prints how its episode ended."""
    check_name("task", task, ("reach", "grasp"))
    robot: Any = make_robot("ur5e", task)
    policy = load_policy(assets_directory() / "policies" / f"{task}-robust.npz")
    robot.reset(np.random.default_rng(0))
    layout = hgail_envs.find_class(task).features_layout
    start, target = layout.split(robot.features())["gripper position"] - robot.offset, robot.target() - robot.offset
    workspace = start + np.array([[-0.2], [0.2]])
    workspace[0, 2] = max(workspace[0, 2], robot.lowest_height)  # above its table: the pads reach below the tool
    goal = np.append(target, np.ones(policy.goal_size - len(target)))  # 1: the cube is to be held there

    def read() -> np.ndarray:
        features = robot.features()
        position, hand = features[layout["gripper position"]], features[GRIPPER.size :]
        return np.concatenate([position - robot.offset, hand])  # without the velocity, which `run` takes

    past = Past(policy.randomization)
    run(policy, read, robot.step, robot.offset, goal, workspace, past, robot.slowdown * CONTROL_PERIOD)
    last = layout.split(robot.features())
    distance = np.linalg.norm(last["gripper position"] - robot.target()) * 1000
    held = f", the cube is {'' if last['hand holds the cube'] else 'not '}held" if task == "grasp" else ""
    print(f"{distance:.1f} mm from the target, where 50 mm are near enough{held}")


if __name__ == "__main__":
    main(*sys.argv[1:])

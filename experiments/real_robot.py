"""A policy in a robot's control loop; the simulated UR5e stands for the robot, behind `read` and `command`."""

from collections.abc import Callable

import numpy as np

from experiments.transfer.robots import make_robot
from hgail_envs.past import Past
from hgail_envs.randomization import Randomization
from hgail_envs.scenes import assets_directory
from hgail_jax.io.policy import load_policy

STEPS, MOST_LATE = 50, 3
MOTION = 0.033  # metres by which a displacement of 1 moves the tool


def run(
    policy: Callable[[np.ndarray], np.ndarray],
    read: Callable[[], np.ndarray | None],  # the tool's position in the robot's frame, metres; None if it is late
    command: Callable[[np.ndarray], None],  # takes an action and returns when its period is over
    offset: np.ndarray,  # from the robot's frame to the policy's
    goal: np.ndarray,  # in the robot's frame, as a camera gives it
    workspace: np.ndarray,  # lowest and highest position, `[2, 3]`, in the robot's frame
    past: Past | None = None,  # that the policy reads before the present observation
) -> bool:
    """Runs an episode, and returns whether it went to its end; it stops if several observations in a row are late."""
    before, late, past = None, 0, past or Past(Randomization())
    for _ in range(STEPS):
        position = read()
        if position is None or not np.isfinite(position).all():
            late, before = late + 1, None  # a difference over two periods would be twice the velocity
            command(np.zeros(4))  # stand still: the last action was for another place
            past.send(np.zeros(4))
            if late == MOST_LATE:
                return False
            continue
        late, moved = 0, np.zeros(3) if before is None else position - before  # metres per action
        seen = np.concatenate([position + offset, moved])
        action = np.clip(policy(np.concatenate([past.before(seen), seen, goal + offset]).astype(np.float32)), -1.0, 1.0)
        action[:3] = np.clip(action[:3], *np.clip((workspace - position) / MOTION, -1.0, 1.0))  # within the workspace
        command(action)
        past.add(action, seen)
        before = position
    return True


if __name__ == "__main__":
    robot, policy = make_robot("ur5e", "reach"), load_policy(assets_directory() / "policies" / "reach-robust.npz")
    robot.reset(np.random.default_rng(0))
    start, target = (place - robot.offset for place in (robot.features()[:3], robot.target()))
    run(
        policy,
        lambda: robot.features()[:3] - robot.offset,
        robot.step,
        robot.offset,
        target,
        start + np.array([[-0.2], [0.2]]),
        Past(policy.randomization),
    )
    print(f"{np.linalg.norm(robot.features()[:3] - robot.target()) * 1000:.1f} mm from the target")

"""Records demonstrations by a script or a policy; a ValueError says that there is none, or that it rarely succeeds."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hgail_envs
from hgail_envs.registry import check_takes_robot
from hgail_envs.validation import check_count, check_name, counted
from hgail_envs.vision.camera_env import CameraEnv
from hgail_jax.io.demonstrations import Demonstrations
from hgail_jax.io.provenance import installed
from hgail_jax.learners import PPO
from hgail_jax.policy import MeanPolicy
from hgail_jax.rollout import Trajectory, rollout
from hgail_jax.settings.defaults import platform_name, task_preset


def run_controller(env: hgail_envs.GoalEnv, name: str, episodes: int, seed: int) -> Trajectory:
    """Rolls out a task's controller of that name, on evaluation goals, with the lift test."""
    if not env.controllers:
        raise ValueError("the task has no controllers, or none that reads its observation")
    check_name("controller", name, env.controllers)
    return _run(env, env.controllers[name], episodes, seed)


def _run(env: hgail_envs.GoalEnv, act: Callable[[jax.Array], jax.Array], episodes: int, seed: int) -> Trajectory:
    """Rolls out a function of the task's observations; what more a `CameraEnv` observes is noted beside each action."""
    size = (env.task if isinstance(env, CameraEnv) else env).observation_size

    def policy(observation: jax.Array, rng: jax.Array) -> tuple[jax.Array, jax.Array]:
        del rng
        return act(observation[:, :size]), observation[:, size:]

    env.prepare()
    return jax.jit(lambda rng: rollout(env, policy, rng, episodes, lift_test=True))(jax.random.key(seed))


def make_for_demonstrations(
    task: str, episodes: int, robot: str | None = None, policy: MeanPolicy | None = None, learner: str = PPO.name
) -> hgail_envs.GoalEnv:
    """Makes a task to record so many demonstrations, on its own robot or another.

    For a controller it has the training physics and the observation of the `learner`, a name in `hgail_jax.LEARNERS`,
    for a policy the reference physics, as in an evaluation, and the policy's observation.
    """
    options: dict[str, Any] = {}
    if policy is not None:
        options |= policy.task_options
    elif hgail_envs.find_class(task).controllers:
        options |= task_preset(hgail_envs.find_class(task), platform_name(), learner=learner).task_options
    else:
        raise ValueError(f"no controller demonstrates {task!r}")
    if "worlds" in hgail_envs.accepted_options(task):
        options["worlds"] = _attempts(episodes)
    if robot is not None:
        check_takes_robot(task)
        options["robot"] = robot
    env = hgail_envs.make(task, **options)
    if policy is not None and policy.observation_size != env.observation_size:
        raise ValueError(
            f"the policy reads {policy.observation_size} numbers; observations of {task} have {env.observation_size}"
        )
    return env


def _attempts(episodes: int) -> int:
    return episodes + episodes // 4 + 4


def successes(
    env: hgail_envs.GoalEnv, task: str, episodes: int, seed: int = 0, policy: MeanPolicy | None = None
) -> tuple[Trajectory, np.ndarray]:
    """Rolls out a policy, or the controller that demonstrates a task; see `rollout`.

    Returns the roll-out and the places in it of its first `episodes` successes. What is noted beside an action is what
    a `CameraEnv` observes more than the task.
    """
    check_count("demonstrations", episodes)
    task_itself = env.task if isinstance(env, CameraEnv) else env
    name = next(iter(task_itself.controllers), "") if policy is None else "the policy"
    act: Any = task_itself.controllers[name] if policy is None else functools.partial(policy, xp=jnp)
    trajectory = _run(env, act, _attempts(episodes), seed)
    succeeded = np.flatnonzero(np.asarray(trajectory.outcome.success))[:episodes]
    if len(succeeded) < episodes:
        raise ValueError(
            f"{name} succeeds too rarely on {task}: {counted(len(succeeded), 'time')}, for"
            f" {counted(episodes, 'demonstration')}"
        )
    return trajectory, succeeded


def record(
    env: hgail_envs.GoalEnv, task: str, episodes: int, seed: int = 0, policy: MeanPolicy | None = None
) -> Demonstrations:
    """Returns the first `episodes` successes of a policy, or of the controller that demonstrates a task."""
    trajectory, succeeded = successes(env, task, episodes, seed, policy)

    def in_order(values: jax.Array, steps: int) -> np.ndarray:
        """Puts episodes before time, and drops the last state, which has no action."""
        return np.moveaxis(np.asarray(values, np.float32), 0, 1)[succeeded, :steps]

    steps = env.episode_length
    return Demonstrations(
        task=task,
        features=in_order(trajectory.features, steps),
        goal=in_order(trajectory.desired, steps),
        action=in_order(trajectory.action, steps),
        success=np.asarray(trajectory.outcome.success, np.float32)[succeeded],
        returns=np.asarray(trajectory.reward.sum(axis=0), np.float32)[succeeded],
        distance_l1=np.asarray(trajectory.outcome.distance_l1, np.float32)[succeeded],
        made_by=made_by(env, seed, policy),
    )


def made_by(env: hgail_envs.GoalEnv, seed: int, policy: MeanPolicy | None) -> dict[str, Any]:
    """Returns the provenance of demonstrations: who made them, the seed, the physics and the versions."""
    task_itself = env.task if isinstance(env, CameraEnv) else env
    return {
        "controller": next(iter(task_itself.controllers)) if policy is None else "policy",
        **({} if env.robot is None else {"robot": env.robot.name}),
        "seed": seed,
        "physics": {option: getattr(task_itself, option, None) for option in ("impl", "substeps")},
        "versions": installed("hgail-jax", "jax", "mujoco-mjx"),
    }

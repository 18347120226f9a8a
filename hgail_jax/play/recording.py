"""Records demonstrations by a scripted controller; a ValueError says that there is none, or that it rarely succeeds."""

import jax
import jax.numpy as jnp
import numpy as np

import hgail_envs
from hgail_envs.registry import check_takes_robot
from hgail_envs.validation import check_count, check_name, counted
from hgail_jax.io.demonstrations import Demonstrations
from hgail_jax.io.provenance import installed
from hgail_jax.rollout import Trajectory, rollout
from hgail_jax.settings.defaults import platform_name, task_preset


def run_controller(env: hgail_envs.GoalEnv, name: str, episodes: int, seed: int) -> Trajectory:
    """Rolls out a task's controller of that name, on evaluation goals, with the lift test."""
    if not env.controllers:
        raise ValueError("the task has no controllers, or none that reads its observation")
    check_name("controller", name, env.controllers)
    controller = env.controllers[name]

    def policy(observation: jax.Array, rng: jax.Array) -> tuple[jax.Array, jax.Array]:
        del rng
        return controller(observation), jnp.zeros(observation.shape[:-1])

    return jax.jit(lambda rng: rollout(env, policy, rng, episodes, lift_test=True))(jax.random.key(seed))


def make_for_demonstrations(task: str, episodes: int, robot: str | None = None) -> hgail_envs.GoalEnv:
    """Makes a task with its training physics, to record so many demonstrations, on its own robot or another."""
    if not hgail_envs.find_class(task).controllers:
        raise ValueError(f"no controller demonstrates {task!r}")
    options = dict(task_preset(hgail_envs.find_class(task), platform_name()).task_options)
    if "worlds" in hgail_envs.accepted_options(task):
        options["worlds"] = _attempts(episodes)
    if robot is not None:
        check_takes_robot(task)
        options["robot"] = robot
    return hgail_envs.make(task, **options)


def _attempts(episodes: int) -> int:
    return episodes + episodes // 4 + 4


def record(env: hgail_envs.GoalEnv, task: str, episodes: int, seed: int = 0) -> Demonstrations:
    """Returns the first `episodes` successes of the controller that demonstrates a task."""
    check_count("demonstrations", episodes)
    name = next(iter(env.controllers))
    trajectory = run_controller(env, name, _attempts(episodes), seed)
    succeeded = np.flatnonzero(np.asarray(trajectory.outcome.success))[:episodes]
    if len(succeeded) < episodes:
        raise ValueError(
            f"{name} succeeds too rarely on {task}: {counted(len(succeeded), 'time')}, for"
            f" {counted(episodes, 'demonstration')}"
        )

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
        made_by={
            "controller": name,
            **({} if env.robot is None else {"robot": env.robot.name}),
            "seed": seed,
            "physics": {option: getattr(env, option, None) for option in ("impl", "substeps")},
            "versions": installed("hgail-jax", "jax", "mujoco-mjx"),
        },
    )

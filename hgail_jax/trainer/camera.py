"""The options of a training that sees pictures, and the task that they make."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, cast

import jax.numpy as jnp

from hgail_envs import TASKS, GoalEnv
from hgail_envs.base import Controller
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.pictures import Pictures
from hgail_jax.io.policy import load_policy
from hgail_jax.policy import MeanPolicy

if TYPE_CHECKING:
    from hgail_jax.trainer.train_options import TrainOptions

TEACHER = "teacher.npz"
"""Name of the teacher's file in a student's folder."""
_OPTIONS = ("teacher", "camera", "picture_size", "look", "renderer", "target", "picture_kind")


class MissingTeacherError(ValueError):
    """All is well with the options of a student's training but that no teacher is named."""


def is_taught(options: "TrainOptions") -> bool:
    """Returns whether the options train a student; with a learner that is named a policy of pictures has no teacher."""
    return options.observe == "camera" and options.learner is None


def with_camera(env: GoalEnv, options: "TrainOptions", devices: int) -> CameraEnv:
    """Returns the task with the pictures that the options ask for, on so many devices.

    A student's has its teacher; where they name none, one that raises a MissingTeacherError once it is asked.

    Raises:
      ValueError: the scene, the renderer or the teacher is not as the options ask for.
      RenderingError: MuJoCo cannot render here.
    """
    cameras = [name.strip() for name in options.camera.split(",")]
    how = options.picture_size, options.renderer, options.look, options.target, options.picture_kind
    pictures = Pictures(env, cameras, *how)
    if pictures.renderer == "opengl" and options.renderer == "auto":
        raise ValueError(
            "--observe camera trains on an NVIDIA GPU, which is not here; --renderer opengl tries it out on a CPU"
        )
    if pictures.renderer == "warp" and devices > 1:
        raise ValueError("the renderer 'warp' runs on one device so far; leave out --devices")
    if not is_taught(options):
        return CameraEnv(env, pictures)
    if options.teacher is None:
        return CameraEnv(env, pictures, cast(Controller, refuse_missing_teacher))
    policy = load_policy(options.teacher)
    _check_task(policy, options)
    sizes = [(one.observation_size, one.action_size) for one in (policy, env)]
    if sizes[0] != sizes[1]:
        raise ValueError(
            f"{options.teacher} reads {policy.observation_size} numbers for {policy.action_size}; an observation of"
            f" {options.task} has {env.observation_size} for {env.action_size}"
        )
    return CameraEnv(env, pictures, cast(Controller, functools.partial(policy, xp=jnp)))


def refuse_missing_teacher(*_: Any) -> NoReturn:
    """Raises a MissingTeacherError."""
    raise MissingTeacherError("--observe camera needs a --teacher, a policy of the task that sees positions")


def _check_task(teacher: MeanPolicy, options: "TrainOptions") -> None:
    """Raises a ValueError for a teacher of another task or robot; a user's own task may have a teacher of another."""
    if teacher.task != options.task and {teacher.task, options.task} <= set(TASKS):
        raise ValueError(f"{options.teacher} was trained on {teacher.task}, not on {options.task}")
    robots = [str(teacher.task_options.get("robot", "fetch")), options.robot]
    if len({Path(robot).name for robot in robots}) > 1:  # a description's file may be in another folder by now
        raise ValueError(f"{options.teacher} was trained on the robot {robots[0]}, not on {robots[1]}")


def kept_teacher(folder: Path) -> Path | None:
    """Returns the teacher's file in the folder of a student's run; None if there is none."""
    path = folder / TEACHER
    return path if path.exists() else None


def refuse_camera_options(given: Mapping[str, Any], defaults: Mapping[str, Any]) -> None:
    """Raises a ValueError for an option of pictures, by its name, where a policy sees positions."""
    for name in _OPTIONS:
        if given[name] != defaults[name]:
            raise ValueError(f"--{name.replace('_', '-')} changes nothing without --observe camera")

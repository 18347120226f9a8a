"""Finds the policies to transfer: the repository's, and others."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments import RESULTS
from experiments.transfer.conditions import TASKS
from hgail_envs import find_class
from hgail_envs.scenes import assets_directory
from hgail_jax.cli.policies import policy_files
from hgail_jax.io.policy import load_policy
from hgail_jax.policy import MeanPolicy

PLAIN = "plain"
"""Label of the policies that were trained without randomisation."""
FILES = {
    PLAIN: "{task}",
    "other arms": "{task}-other-arms",
    "known delay": "{task}-full-known-delay",
    "robust": "{task}-robust",
}
"""Names of the package's policies, by label; those of grasp for `other-arms` and `full-known-delay` track the cube."""
SCRIPT = "script"
"""Label of the scripted controllers, and what stands for a policy's file."""
SCRIPTED_TASKS = ("grasp", "pick-and-place")
"""Tasks of table 4 with a row of their scripted controller."""
Policies = Mapping[str, Mapping[str, Sequence[Path]]]
"""Files of policies by label and then by task."""


class Script:
    """The first scripted controller of a task as a policy, which shows what a robot's hand allows.

    In grasp it observes the cube's place at the start: at each step, it would chase a cube that its fingers push, and
    pick fewer.

    Args:
      task: a name in `hgail_envs.TASKS`, of a task with controllers.
    """

    def __init__(self, task: str) -> None:
        self.task = task
        self.task_options: dict[str, Any] = {}
        self._act = jax.jit(next(iter(find_class(task).controllers.values())))

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Returns an action, `[action_size]`, for an observation, `[observation_size]`."""
        return np.asarray(self._act(observation))


def policy_paths(task: str, label: str = PLAIN) -> list[Path]:
    """Returns the files of a task's policies: the package's, if there is one, and other seeds of the same run."""
    name = FILES[label].format(task=task)
    seeds = sorted((RESULTS / "policies").glob(f"{name}-[0-9].npz"))
    return [*(assets_directory() / "policies").glob(f"{name}.npz"), *seeds]


def load(path: Path, task: str) -> MeanPolicy | Script:
    """Loads a policy, or a task's `SCRIPT`."""
    return Script(task) if path == Path(SCRIPT) else load_policy(path)


def robot_options(policy: MeanPolicy | Script) -> dict[str, Any]:
    """Returns the task options that a policy was trained with and its robot needs to know.

    `Sensors` sees to `cube`, and `achieved` is of goals in training alone.
    """
    return {name: value for name, value in policy.task_options.items() if name not in ("cube", "achieved")}


def table_policies() -> Policies:
    """Returns the policies of table 4: the repository's, and scripts."""
    return {**find_policies(tuple(TASKS)), SCRIPT: {task: [Path(SCRIPT)] for task in SCRIPTED_TASKS}}


def load_policies(task: str, path: Path | None = None) -> list[MeanPolicy | Script]:
    """Loads the policies of a file or a run's folder, `SCRIPT`, or all plain ones of the repository for a task.

    Raises:
      ValueError: no policy is found, or a file is not a policy of the task.
      OSError: a file cannot be read.
    """
    files = [path] if path == Path(SCRIPT) else policy_files(path) if path else policy_paths(task)
    policies = [load(file, task) for file in files]
    if not policies:
        raise ValueError(f"no policy of {task!r} comes with the repository; give one by --policy")
    for policy in policies:
        if policy.task != task:
            raise ValueError(f"the policy is for {policy.task!r}, not for {task!r}")
    return policies


def find_policies(tasks: Sequence[str], more: Sequence[str] = ()) -> Policies:
    """Returns the repository's policies, and others.

    Args:
      tasks: of the repository's.
      more: each `label=path`, a policy's file or a run's folder; labels may repeat.

    Raises:
      ValueError: an entry is not of this form, or has no policy.
      OSError: a file cannot be read.
    """
    found: dict[str, dict[str, list[Path]]] = {}
    for label in FILES:
        found[label] = {task: paths for task in tasks if (paths := policy_paths(task, label))}
    for entry in more:
        label, separator, path = entry.partition("=")
        if not (label and separator and path) or label in FILES:
            raise ValueError(f"policies {entry!r} is not label=path, with another label than {', '.join(FILES)}")
        if not Path(path).exists():
            raise ValueError(f"there is no file or folder {path}")
        for file in policy_files(Path(path)):
            policy = load_policy(file)
            if options := robot_options(policy):
                given = ", ".join(f"{name}={value}" for name, value in options.items())
                raise ValueError(f"{file} was trained with task options {given}; curves are of tasks as they are alone")
            found.setdefault(label, {}).setdefault(policy.task, []).append(file)
    return {label: files for label, files in found.items() if files}

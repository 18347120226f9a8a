"""Policies that a command is given: a file, a run's folder, or one that comes with the package.

What cannot be found, read or used together is a ValueError or an OSError, whose message the command prints.
"""

import dataclasses
import re
import sys
from pathlib import Path
from typing import Annotated

import hgail_envs
from hgail_envs.randomization import LEVELS, Randomization
from hgail_envs.randomized import RandomizedEnv, randomize
from hgail_envs.registry import check_takes_robot
from hgail_envs.robots import ROBOTS, check_robot
from hgail_envs.scenes import assets_directory
from hgail_envs.validation import MOST_SEED, check_count, check_name
from hgail_envs.vision.camera_env import CameraEnv
from hgail_envs.vision.pictures import Pictures
from hgail_envs.vision.rendering import RenderingError
from hgail_jax.io.files import from_here
from hgail_jax.io.policy import AnyPolicy, load_any_policy
from hgail_jax.terminal import say
from hgail_jax.trainer.train_options import unless_given
from hgail_jax.vision.policy import CameraPolicy

DEFAULT_TASK = "grasp"
"""Task of a command that is given neither a task nor a policy."""
_OF_ROBUST = ("mild", "full", "mild-history", "full-history")  # levels that full-history, the robust one's, covers


@dataclasses.dataclass(frozen=True)
class PolicyOptions:
    """Options of a command that runs policies."""

    task: Annotated[str | None, unless_given(f"the task of --policy, or {DEFAULT_TASK}", "STR")] = None
    """A task's name, e.g. reach or grasp, or 'module:Class' of your own."""
    policy: Annotated[Path | None, unless_given("one that comes with the package", "FILE|FOLDER|NAME")] = None
    """The policy's file, a run's folder, for its first seed or to evaluate all, or the name of one that comes with the
    package, such as push-camera. By default the task's plain one, or with --randomize the one trained under that level,
    else the robust one."""
    randomize: Annotated[str | None, unless_given("as the policy was trained", "|".join(LEVELS))] = None
    """How much each episode is randomised; see docs/robust.md."""
    robot: Annotated[str | None, unless_given("the policy's", "|".join((*ROBOTS, "FILE.toml")))] = None
    """The robot that acts, of a task of an arm; another than the policy's is new to it."""
    seed: int = 0
    """Of the episodes."""

    def check(self, episodes: int) -> None:
        """Raises a ValueError if a number is out of range, or if there is no such level."""
        check_count("episodes", episodes)
        check_count("seed", self.seed, least=0, most=MOST_SEED)
        if self.randomize is not None:
            check_name("randomize", self.randomize, LEVELS)
        if self.robot is not None:
            check_robot(self.robot)


def policy_files(path: Path) -> list[Path]:
    """Returns a policy's file, that of the policy of this name in the package, or those of a run's folder, by seed."""
    if not path.exists():
        of_package = _of_package(str(path))
        if len(path.parts) != 1 or not of_package.exists():
            raise FileNotFoundError(f"there is no file or folder {path}, nor a policy of that name in the package")
        return [of_package]
    if not path.is_dir():
        return [path]
    found = list((path / "policies").glob("*.npz")) or list(path.glob("*.npz"))
    if not found and (path / "config.json").exists() and not (path / "summary.json").exists():
        raise ValueError(f"{path} has no policies until the run ends; resume it with its options and --resume {path}")
    if not found:
        raise ValueError(f"{path} does not hold a policy: it is no regular file, nor a run's folder with policies")
    seeds = [file for file in found if re.fullmatch(r"seed-\d+\.npz", file.name)]  # no copies of theirs
    return sorted(seeds or found, key=lambda file: (len(file.name), file.name))  # seed 2 before seed 10


def find_task(task: str | None, path: Path | None) -> str:
    """Returns the task that is named, else the policy's, else the default one.

    A policy's task that is none of this package is refused: to load it would run code that the file names, and the file
    need not be trusted.
    """
    if task is not None or path is None:
        return task or DEFAULT_TASK
    of_policy = load_any_policy(policy_files(path)[0]).task
    if of_policy not in hgail_envs.TASKS:
        raise ValueError(
            f"{path} was trained on {of_policy!r}, which is none of this package; name a task of your own by --task"
        )
    return of_policy


def find_policies(
    task: str | None, path: Path | None, level: str | None = None, exact: bool = False
) -> list[tuple[Path, AnyPolicy]]:
    """Returns the policies of a file or a run's folder `path`, and their files; for None, see `shipped`.

    Where `task` is None it is the policy's own, whose code is not loaded. A policy of another task becomes one of
    `task`, with a line, if it fits: a user's task may have got another name.
    """
    if path is None and task is not None:
        hgail_envs.find_class(task)
        path = shipped(task, level, exact)
    if path is None:
        raise ValueError(_none_is_shipped(task, level))
    loaded: list[tuple[Path, AnyPolicy]] = [(file, load_any_policy(file)) for file in policy_files(path)]
    trained_on = {policy.task for _, policy in loaded} - {task}
    if task is None or not trained_on:
        return loaded
    fitted = [(file, dataclasses.replace(policy, task=task)) for file, policy in loaded]
    try:
        for _, policy in fitted:
            make_task(policy, task, None)
    except ValueError as error:
        raise ValueError(f"the policy is for {min(trained_on)!r}, not for {task!r}: {error}") from None
    say(f"{path} was trained on {', '.join(sorted(trained_on))}; --task makes it {task}", sys.stderr)
    return fitted


def shipped(task: str, level: str | None = None, exact: bool = False) -> Path | None:
    """Returns the file of the policy that comes with the package, or None.

    For a level of randomisation it is the one trained under it, else the robust one, else the plain one; if `exact` is
    set, none that was trained under less.
    """
    if level in (None, "none"):
        names = [task]
    else:
        names = [f"{task}-{level}", *([] if exact and level not in _OF_ROBUST else [f"{task}-robust"])]
        names += [] if exact else [task]
    paths = map(_of_package, names)
    return next((path for path in paths if path.exists()), None)


def _of_package(name: str) -> Path:
    return assets_directory() / "policies" / f"{name}.npz"


def _none_is_shipped(task: str | None, level: str | None) -> str:
    """Returns a line that says which policies of a task come with the package, none of which is for the level."""
    names = [f"{task}", *(f"{task}-{name}" for name in (*LEVELS, "robust"))]
    paths = [path for name in names if (path := _of_package(name)).exists()]
    if not paths:
        return f"no policy of {task} comes with the package; name one by --policy"
    known = ", ".join(str(from_here(path)) for path in paths)
    return f"no policy of {task} for --randomize {level} comes with the package; name one by --policy, e.g. {known}"


def make_task(policy: AnyPolicy, task: str, level: str | None, **physics: str | int | None) -> hgail_envs.GoalEnv:
    """Makes the task that a policy is for, with the policy's options and past, and the `physics` that it takes."""
    accepted = hgail_envs.accepted_options(task)
    if physics.get("robot") is not None:
        check_takes_robot(task)
    taken = {name: value for name, value in physics.items() if name in accepted and value is not None}
    env = randomize(hgail_envs.make(task, **policy.task_options | taken), randomization(policy, level))
    if isinstance(policy, CameraPolicy):
        return _with_camera(policy, env)
    for kind, verb in (("observation", "reads"), ("goal", "has goals of"), ("action", "commands")):
        given, needed = (getattr(one, f"{kind}_size") for one in (policy, env))
        if given != needed:
            raise ValueError(f"the policy {verb} {given} numbers; {kind}s of {task} have {needed}")
    return env


def _with_camera(policy: CameraPolicy, env: hgail_envs.GoalEnv) -> CameraEnv:
    """Returns a task with the pictures that a policy sees, in the scene's own look."""
    if isinstance(env, RandomizedEnv):
        raise ValueError("a policy that sees pictures was trained without --randomize; leave it out")
    try:
        seen = CameraEnv(env, Pictures(env, policy.cameras, policy.size, target=policy.target, kind=policy.kind))
    except RenderingError as error:
        raise ValueError(str(error)) from error
    for what, given, needed in (
        ("takes", policy.mean.size, len(seen.known)),
        ("commands", policy.action_size, seen.action_size),
        ("predicts the objects' positions in", policy.centre.size, len(seen.objects)),
        ("has goals of", policy.goal_size, seen.goal_size if policy.target == "given" else 0),
    ):
        if given != needed:
            raise ValueError(f"the policy {what} {given} numbers; in {policy.task} there are {needed}")
    return seen


def randomization(policy: AnyPolicy, level: str | None) -> Randomization:
    """Returns a level with the policy's own `history` and `known_delay`; for None what its training had."""
    trained = policy.randomization
    if level is None:
        return trained
    return dataclasses.replace(LEVELS[level], history=trained.history, known_delay=trained.known_delay)


def describe_policy(path: Path, policy: AnyPolicy, level: str | None, robot: str | None = None) -> str:
    """Returns a line that names the policy's file and the level, and says if its training had no disturbance.

    It says, too, if the policy was trained on another robot than the one that it is to have here.
    """
    sizes, trained = randomization(policy, level), policy.randomization
    new = " (trained without)" if trained == trained.nominal() and sizes != sizes.nominal() else ""
    own = str(policy.task_options.get("robot", "fetch"))
    other = "" if robot in (None, own) else f", trained on {own}, here on {robot}"
    return f"policy {from_here(path)}{other}, {_disturbances(sizes, level)}{new}"


def _disturbances(sizes: Randomization, level: str | None) -> str:
    """Names the `level`, or for None that of the training, and says if the policy is shown another past."""
    if sizes == sizes.nominal():
        return "nominal"
    if level is None:
        levels = {name: dataclasses.replace(known, ramp=sizes.ramp) for name, known in LEVELS.items()}
        return f"randomised: {next((name for name, known in levels.items() if known == sizes), 'as in its training')}"
    asked = LEVELS[level]
    same = (asked.history, asked.known_delay) == (sizes.history, sizes.known_delay)
    return f"randomised: {level}" + ("" if same else ", shown the past as in its training")

"""Writes a trained policy for other programs: as ONNX, as StableHLO, or as npz for NumPy."""

import dataclasses
import importlib.util
import json
from pathlib import Path
from typing import Annotated, Literal

from hgail_envs.randomization import LEVELS
from hgail_envs.registry import TASKS
from hgail_envs.validation import check_count, check_name, counted
from hgail_jax.cli.command_line import fail, parse
from hgail_jax.cli.policies import DEFAULT_TASK, find_policies, make_task, policy_files
from hgail_jax.io.camera_export import export_camera_onnx, export_camera_policy
from hgail_jax.io.export import check_described, export_onnx, export_policy
from hgail_jax.io.files import check_new_file, from_here
from hgail_jax.io.policy import AnyPolicy, save_policy
from hgail_jax.lerobot import check_installed, check_shown
from hgail_jax.play.evaluation import Evaluation
from hgail_jax.policy import MeanPolicy
from hgail_jax.terminal import StatusLine, say
from hgail_jax.trainer.train_options import unless_given
from hgail_jax.vision.policy import CameraPolicy

PROGRAM = "hgail export"
FORMATS = {".onnx": "ONNX", ".mlirbc": "StableHLO", ".npz": "npz"}
"""Formats, by the end of a file's name."""
LEROBOT = "lerobot"


@dataclasses.dataclass(frozen=True)
class Options:
    """Writes a trained policy for other programs; the end of the file's name decides the format."""

    task: Annotated[str | None, unless_given(f"the task of --policy, or {DEFAULT_TASK}", "STR")] = None
    """A task's name, or 'module:Class' of your own."""
    policy: Annotated[Path | None, unless_given("one that comes with the package", "FILE|FOLDER|NAME")] = None
    """The policy's file, the folder of a run of one seed, or the name of one that comes with the package, such as
    push-camera. By default the task's plain one, or with --randomize the one trained under that level, for mild and
    full levels else the robust one."""
    randomize: Annotated[str | None, unless_given("the plain policy", "|".join(LEVELS))] = None
    """Level of the training of the policy, of those that come with the package."""
    format: Annotated[Literal["lerobot"] | None, unless_given("by the end of the file's name", "lerobot")] = None
    """`lerobot` writes a folder for `lerobot-eval --policy.path`; see docs/lerobot.md."""
    out: Annotated[Path | None, unless_given("<task>.onnx, or <task>-lerobot", "FILE|FOLDER")] = None
    """What to write, which must not exist: a file .onnx (extra `onnx`), .mlirbc for StableHLO or .npz, or a folder."""
    episodes: int = 100
    """Episodes for the success rate in an ONNX file's metadata, randomised as in training; 0 is none. For a policy
    in its run's folder the run's final evaluation is taken."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, PROGRAM, __doc__, arguments)
    try:
        _check(options)
        # The task's own code is not needed, so that a file's task may be any.
        task = options.task or (DEFAULT_TASK if options.policy is None else None)
        found = find_policies(task, options.policy, options.randomize, exact=True)
        if len(found) > 1:
            raise ValueError(f"{options.policy} has {len(found)} policies; name one, e.g. {from_here(found[0][0])}")
        path, policy = found[0]
        trusted = policy.task in TASKS or options.task is not None
        kind, out = _kind(options, policy, trusted)
        if kind == ".onnx":
            if importlib.util.find_spec("onnx") is None:
                raise ValueError("ONNX needs the package onnx: pip install 'hgail-jax[onnx]'")
            if isinstance(policy, MeanPolicy):
                check_described(policy, trusted)
            success = _success(path, policy, options.episodes, trusted)
    except OverflowError as error:
        fail(PROGRAM, error, 1)
    except (ValueError, OSError) as error:
        fail(PROGRAM, error, 2)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        if kind == ".npz":
            save_policy(out, policy)
        elif kind == LEROBOT:
            with StatusLine("loading LeRobot"):
                from hgail_jax.lerobot.policy import export_lerobot

                export_lerobot(out, policy)
        elif isinstance(policy, CameraPolicy):
            export_camera_onnx(out, policy, success) if kind == ".onnx" else export_camera_policy(out, policy)
        elif kind == ".onnx":
            export_onnx(out, policy, success, trusted)
        else:
            export_policy(out, policy)
    except (OSError, ValueError) as error:
        fail(PROGRAM, error, 1)
    say(f"policy {from_here(path)} as {FORMATS.get(kind, 'LeRobot')} -> {out}")


def _kind(options: Options, policy: AnyPolicy, trusted: bool) -> tuple[str, Path]:
    """Returns the format, an ending of `FORMATS` or `LEROBOT`, and what to write; a ValueError if it cannot be."""
    name = policy.task.replace(":", ".")
    if options.format is None:
        out = options.out or Path(f"{name}.onnx")
        check_new_file(out, FORMATS)
        return out.suffix.lower(), out
    check_installed()
    out = options.out or Path(f"{name}-lerobot")
    check_new_file(out)
    if not trusted:
        raise ValueError(f"{policy.task!r} is none of this package; name a task of your own by --task")
    check_shown(policy)
    return LEROBOT, out


def _check(options: Options) -> None:
    check_count("episodes", options.episodes, least=0)
    if options.randomize is not None:
        check_name("randomize", options.randomize, LEVELS)
        if options.policy is not None:
            raise ValueError("--randomize chooses among the policies that come with the package; leave out --policy")


def _success(path: Path, policy: AnyPolicy, episodes: int, trusted: bool) -> float | None:
    """Returns the success of a policy in the final evaluation of its run, or else in episodes that are run now.

    Returns None if no episodes are asked for, or if the task is not trusted: making one that only the policy's file
    names, and that is not of this package, would run code that the file chose.
    """
    known = _success_in_run(path)
    if known is not None or not episodes or not trusted:
        return known
    env = make_task(policy, policy.task, None)
    with StatusLine(f"compiling and running {counted(episodes, 'episode')} of {policy.task}"):
        evaluation = Evaluation(env, 0, episodes)
        return round(float(evaluation(policy).success) * evaluation.episodes) / evaluation.episodes


def _success_in_run(path: Path) -> float | None:
    folder = path.parent.parent
    try:
        rates = json.loads((folder / "summary.json").read_text())["success_rate"]["per_seed"]
        files = policy_files(folder)
        return float(rates[files.index(path)]) if len(rates) == len(files) else None
    except (OSError, ValueError, LookupError, TypeError):
        return None

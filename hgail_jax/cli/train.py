"""Trains several seeds of a method on a task, side by side, and writes the results to a folder."""

import argparse
import contextlib
import dataclasses
import itertools
import json
import shlex
import shutil
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np

from hgail_envs import find_class
from hgail_envs.validation import counted
from hgail_envs.vision.rendering import RenderingError
from hgail_jax.cli.command_line import NO_DEVICE, fail, is_out_of_memory, parse, with_new_names
from hgail_jax.devices.processes import HEARTBEAT_TIMEOUT, RESUME, end_without_the_others, join
from hgail_jax.devices.sharding import ReplicaError, is_first_process
from hgail_jax.io.files import from_here
from hgail_jax.io.policy import load_any_policy
from hgail_jax.learners import LEARNERS
from hgail_jax.play.playback import film
from hgail_jax.settings.defaults import has_own_settings, platform_name
from hgail_jax.terminal import in_a_thread, say, stop_on_signal
from hgail_jax.trainer.camera import MissingTeacherError
from hgail_jax.trainer.folder import RunFolder, open_run_folder, student_folder
from hgail_jax.trainer.run import Run
from hgail_jax.trainer.statistics import confidence_interval
from hgail_jax.trainer.train_options import TrainOptions, plan, task_defaults, unless_given
from hgail_jax.trainer.training import train_run

PROGRAM = "hgail train"

_OF_TEACHER_TOO = (
    *("task", "seeds", "first_seed", "robot", "impl", "substeps", "task_options", "devices", "checkpoint_every"),
    *("evaluation_episodes", "logger"),
)
"""Options of a student's training that its teacher's has too."""


@dataclasses.dataclass(frozen=True)
class Command(TrainOptions):
    """Trains several seeds of a method on a task, side by side, and writes the results to a new folder."""

    distributed: Annotated[Literal["auto"] | None, unless_given("none", "auto")] = None
    """With auto, train with the processes that Slurm, Open MPI or Kubernetes started beside this one."""
    coordinator: Annotated[str | None, unless_given("none", "HOST:PORT")] = None
    """host:port of the first of several processes that train together; each has all options of the others but one."""
    num_processes: int = 1
    """Number of these processes."""
    process_id: int = 0
    """Which of them this one is, from 0; the first writes the files."""
    heartbeat_timeout: int = HEARTBEAT_TIMEOUT
    """Seconds after which the others end if one of several processes is silent."""
    video: bool = False
    """Film the policy of the first seed after training, of a task with a scene."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    words = sys.argv[1:] if arguments is None else arguments
    command = parse(Command, PROGRAM, _description(words), words)
    with contextlib.ExitStack() as held:
        try:
            auto = command.distributed == "auto"
            numbers = (command.coordinator, command.num_processes, command.process_id)
            join(*numbers, auto=auto, heartbeat_timeout=command.heartbeat_timeout)
            given = {field.name: getattr(command, field.name) for field in dataclasses.fields(TrainOptions)}
            options = TrainOptions(**given)
            try:
                run = plan(options, platform_name())
            except MissingTeacherError:
                options = dataclasses.replace(options, teacher=_teacher(options, words))
                run = plan(options, platform_name())
            if command.video and run.env.scene is None:
                raise ValueError(f"task {command.task!r} has no scene to film; leave out --video")
            folder = held.enter_context(open_run_folder(run, command.out, command.resume))
        except (ValueError, OSError, RenderingError) as error:
            fail(PROGRAM, error, 2)
        if not (folder.path / "summary.json").exists():  # else it is complete, as was printed
            _announce(run, command, folder.path)
        resume_hint = _resume_hint(words, folder.path) if run.config.learner.resumes else "it keeps no checkpoint"
        summary = _train(run, folder, resume_hint)
        if not is_first_process():
            return
        if summary is None:
            say(f"{_stopped(run, folder)}; {resume_hint}")
            return
        _report(summary, folder.path)
        if command.video:
            _film(run, folder)


def _announce(run: Run, command: Command, folder: Path) -> None:
    """Prints what is trained, and whether it is with settings that were not chosen for the task."""
    size = f"{counted(command.seeds, 'seed')} × {counted(run.config.num_envs, 'env')}"
    robot = "" if command.robot == Command.robot else f" with {command.robot}"
    say(f"{run.method} on {command.task}{robot}, {size} -> {folder}")
    learner = run.config.learner.name
    of_task = learner in LEARNERS and command.preset == Command.preset
    if of_task and not has_own_settings(find_class(command.task), learner, platform_name()):
        say(f"{command.task} has no settings of its own for {learner} and uses shared ones: see GoalEnv.training")


def _teacher(options: TrainOptions, words: list[str]) -> Path:
    """Returns the file of a student's teacher, which is trained now."""
    teacher = _teacher_options(options, student_folder(options.task, "camera", options.out, options.resume))
    run = plan(teacher, platform_name())
    with open_run_folder(run, teacher.out, teacher.resume) as folder:
        say(f"first the teacher: {run.method} on {teacher.task}, {counted(teacher.seeds, 'seed')} -> {folder.path}")
        later = f"resume with: {_command(words)}"
        summary = _train(run, folder, later)
        if summary is None:
            fail(PROGRAM, f"{_stopped(run, folder)} of the teacher; {later}", 1)
        _report(summary, folder.path)
        best = _best_policy(folder.path)
    say(f"the teacher is {from_here(best)}")
    return best


def _teacher_options(options: TrainOptions, folder: Path) -> TrainOptions:
    """Returns the options of the training of a teacher, by the task's default method, for a student's training.

    The `folder` is the student's. The teacher's is beside it, and resumed where it is there already.
    """
    out = folder.with_name(f"{folder.name}-teacher")
    place: dict[str, Any] = {"resume": str(out)} if out.exists() else {"out": out}
    return TrainOptions(**place, **{name: getattr(options, name) for name in _OF_TEACHER_TOO})


def _best_policy(folder: Path) -> Path:
    """Returns the policy of the seed of a finished run that had the most success, of equal ones the first."""
    summary = json.loads((folder / "summary.json").read_text())
    first = json.loads((folder / "config.json").read_text())["first_seed"]
    success = summary["success_rate"]["per_seed"]
    return folder / "policies" / f"seed-{first + success.index(max(success))}.npz"


def _description(words: list[str]) -> str:
    """Returns the text above the options; for the help with the numbers of the task that is named."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("task", "method", "preset", "learner", "randomize", "observe"):
        parser.add_argument(f"--{name}", default=getattr(TrainOptions, name))
    if not {"-h", "--help"} & set(words):
        return __doc__ or ""
    try:
        named, _ = parser.parse_known_args(words)
        numbers = task_defaults(platform=platform_name(), **vars(named))
    except (ValueError, argparse.ArgumentError, *NO_DEVICE):  # no such task, method or preset, or nothing to train on
        return __doc__ or ""
    said = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in numbers.items())
    return f"{__doc__}\n\nThe task {named.task} has {said}."


def _train(run: Run, folder: RunFolder, resume_hint: str) -> dict[str, Any] | None:
    """Trains; ends the process with one line if the training diverges or a file cannot be written."""

    def nothing_to_save() -> str | None:
        if folder.in_rounds.is_set() or jax.process_count() > 1:  # the others would wait for this one
            return None
        return f"\n{PROGRAM}: {_stopped(run, folder)}; {resume_hint}"

    try:
        with stop_on_signal(nothing_to_save) as stop:
            return in_a_thread(lambda: train_run(run, folder, stop))
    except (FloatingPointError, OverflowError, ReplicaError) as error:
        saved = folder.checkpoints.saved
        last = "none" if saved is None else folder.checkpoints.path(saved)
        fail(PROGRAM, f"the training stops: {error}; the last good checkpoint: {last}", 1)
    except OSError as error:
        fail(PROGRAM, f"the run stops: {error}; {resume_hint}", 1)
    except (MemoryError, jax.errors.JaxRuntimeError, ValueError) as error:
        if is_out_of_memory(error):
            fail(PROGRAM, f"out of memory; a run with fewer --num-envs or --seeds takes less than {folder.path}", 1)
        if jax.process_count() == 1:
            raise
        # An exchange with a process that died raises errors of these types.
        end_without_the_others(f"{PROGRAM}: the training stops: {error}; {RESUME}")


def _stopped(run: Run, folder: RunFolder) -> str:
    """Returns a line with the round of a stopped run's last checkpoint, if it keeps any."""
    if not run.config.learner.resumes:
        return "stopped"
    done = folder.checkpoints.saved  # with round 0
    return f"stopped after round {done - 1} of {run.config.rounds}" if done else "stopped before round 0"


def _resume_hint(words: list[str], folder: Path) -> str:
    """Returns a line with the command that resumes a run: its own words, less another folder."""
    pairs = itertools.pairwise(["", *with_new_names(words)])
    kept = [word for before, word in pairs if not {before, word.partition("=")[0]} & {"--out", "--resume"}]
    return f"resume with: {_command([*kept, '--resume', str(folder)])}"


def _command(words: list[str]) -> str:
    """Returns the command line of `hgail train` with these words."""
    script = Path(sys.executable).with_name("hgail")  # of an environment that need not be activated
    hgail = from_here(script) if script.exists() and shutil.which("hgail") != str(script) else "hgail"
    return shlex.join([str(hgail), "train", *words])


def _film(run: Run, folder: RunFolder) -> None:
    """Writes rollout.mp4, or says in one line why it cannot."""
    path = folder.path / "rollout.mp4"
    try:
        policy = load_any_policy(folder.path / "policies" / f"seed-{run.first_seed}.npz")
        film(path, run.env.reference_physics(), policy)
        say(str(path))
        for logger in folder.loggers:
            logger.film(path)
    except Exception as error:  # rendering and encoding raise errors of many types, and the results are written
        say(f"no video: {str(error).splitlines()[0] if str(error) else type(error).__name__}", sys.stderr)


def _report(summary: dict[str, Any], folder: Path) -> None:
    success, distance, seconds = summary["success_rate"], summary["distance_l1"], summary["wall_seconds"]
    worst = f" (worst seed {min(success['per_seed']):.3f})" if summary["seeds"] > 1 else ""
    say(
        f"success {_mean(success)}{worst}, L1 distance {distance['mean']:.3f} m, "
        f"{summary['env_steps_per_seed']:,} env steps per seed\n"
        f"compile {seconds['compile']:.1f} s, train {seconds['train']:.1f} s at "
        f"{summary['env_steps_per_second']:,.0f} env steps/s, evaluate {seconds['evaluation']:.1f} s, "
        f"total {seconds['total']:.1f} s -> {folder}"
    )
    if "nominal_success_rate" in summary:
        say(f"nominal: success {_mean(summary['nominal_success_rate'])}")
    if summary["diverged_seeds"]:
        say(f"updates that were not finite were undone: {', '.join(summary['diverged_seeds'])}", sys.stderr)


def _mean(rate: dict[str, Any]) -> str:
    """Returns a mean over seeds and, from three on, the 95 % interval around it.

    >>> _mean({"mean": 0.5, "per_seed": [0.4, 0.5, 0.6]}), _mean({"mean": 0.5, "per_seed": [0.4, 0.6]})
    ('0.500 ± 0.248', '0.500')
    """
    half = float(confidence_interval(np.array(rate["per_seed"])))
    return f"{rate['mean']:.3f}" + (f" ± {half:.3f}" if np.isfinite(half) else "")

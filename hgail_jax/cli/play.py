"""Rolls out a trained policy: in the browser, in MuJoCo's viewer where there is a display, or as a film."""

import dataclasses
import itertools
import logging
import os
from pathlib import Path
from typing import Annotated

import jax

import hgail_envs
from hgail_envs.validation import check_count
from hgail_envs.vision.rendering import RenderingError
from hgail_jax.cli.command_line import fail, parse
from hgail_jax.cli.policies import PolicyOptions, describe_policy, find_policies, find_task, make_task, shipped
from hgail_jax.io.files import check_new_file
from hgail_jax.io.policy import AnyPolicy
from hgail_jax.play.playback import FORMATS, film, show
from hgail_jax.terminal import say
from hgail_jax.trainer.train_options import unless_given

PROGRAM = "hgail play"

_FIRST_PORT, _MOST_PORT = 8080, 65535


@dataclasses.dataclass(frozen=True)
class Options(PolicyOptions):
    """Rolls out a trained policy: in MuJoCo's viewer where there is a display, else as a film."""

    episodes: int = 3
    """Episodes to play; the page plays until it is stopped."""
    out: Annotated[Path | None, unless_given("the viewer; <task>.mp4 without a display", "FILE")] = None
    """Film to write, .mp4, .gif or .webp, which must not exist."""
    web: bool = False
    """Serve a page on which the target can be dragged while the policy acts (extra `web`)."""
    port: Annotated[int | None, unless_given("the first that is free from 8080 on", "INT")] = None
    """The page's port."""
    host: str = "127.0.0.1"
    """The network address to serve the page on; by default it is for this machine alone."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line `arguments`, or the process's own."""
    options = parse(Options, PROGRAM, __doc__, arguments)
    shows = options.out is None and bool(os.environ.get("DISPLAY"))
    try:
        _check(options)
        task = find_task(options.task, options.policy)
        _check_scene(task, options.policy)
        if options.web:
            _serve(options, task)
            return
        path = options.out or _free_name(task.replace(":", "."))
        if not shows:
            check_new_file(path, FORMATS)
        env, policy = _load(task, options.policy, options.randomize, robot=options.robot)
    except (ValueError, OSError) as error:
        fail(PROGRAM, error, 2)
    try:
        if shows:
            outcomes = show(env, policy, options.episodes, options.seed)
        else:
            outcomes = film(path, env, policy, options.episodes, options.seed)
            say(str(path))
    except (RenderingError, OSError, ValueError) as error:
        fail(PROGRAM, error, 1)
    say(f"{sum(outcomes)} of {len(outcomes)} episodes succeeded")


def _check(options: Options) -> None:
    options.check(options.episodes)
    if options.port is not None:
        check_count("port", options.port, most=_MOST_PORT)
    if options.web and options.out is not None:
        raise ValueError("--web writes no film; leave out --out")
    if not options.web and (options.port is not None or options.host != Options.host):
        raise ValueError("--port and --host are for --web")


def _free_name(stem: str) -> Path:
    """Returns the first free name for a film: the stem's, or the stem's with a number from 2 on."""
    numbered = (Path(f"{stem}-{number}.mp4") for number in itertools.count(2))
    return next(path for path in itertools.chain([Path(f"{stem}.mp4")], numbered) if not os.path.lexists(path))


def _check_scene(task: str, path: Path | None) -> None:
    """Refuses a task without a scene, before anything else; the policy's file, if one is named, goes with no other."""
    if hgail_envs.find_class(task).scene is None:
        played = ", ".join(name for name in hgail_envs.TASKS if shipped(name))
        other = "" if path is None else f"{path} plays no other; without --policy "
        raise ValueError(f"task {task!r} has no scene to show; {other}choose from {played}")


def _load(
    task: str, path: Path | None, level: str | None, **physics: str | None
) -> tuple[hgail_envs.GoalEnv, AnyPolicy]:
    """Returns the task and the policy, and prints the policy's file and level; see `find_policies` and `make_task`."""
    file, policy = find_policies(task, path, level)[0]
    env = make_task(policy, task, level, **physics)
    say(describe_policy(file, policy, level, physics.get("robot")))
    return env, policy


def _serve(options: Options, shown: str) -> None:
    """Serves the page, which begins with the task `shown`, until Ctrl-C."""
    jax.config.update("jax_platforms", "cpu")  # one robot gains nothing by a GPU, which may be at work for others
    try:
        from hgail_jax.play.page import Page, free_port
    except ModuleNotFoundError as error:
        raise ValueError(f"--web needs the package {error.name}: pip install 'hgail-jax[web]'") from None
    from hgail_jax.play.session import Session

    def open_session(task: str, seed: int) -> Session:
        path = options.policy if task == shown else None
        env, policy = _load(task, path, options.randomize, impl="c", robot=options.robot)
        return Session(env, policy, seed)

    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # it prints a traceback for all but a GET
    port = free_port(options.host, options.port, _FIRST_PORT)
    others = [task for task in hgail_envs.TASKS if task != shown and shipped(task, options.randomize)]
    say(f"compiling {shown} ...")
    page = Page(open_session, [shown, *others], options.seed, options.host, port)
    host = f"[{options.host}]" if ":" in options.host else options.host
    say(f"http://{host}:{page.port} shows {shown}; Ctrl-C stops")
    page.run()

"""Command lines: options by tyro, mistakes in one line, compiled programs in a cache."""

import atexit
import contextlib
import dataclasses
import difflib
import gc
import os
import shutil
import sys
import tempfile
import typing
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn, TypeVar, cast

import jax
import tyro
from tyro import _errors as tyro_errors

from hgail_envs.workarounds import configure_xla
from hgail_jax.terminal.signals import stop_in_one_line

OptionsT = TypeVar("OptionsT")

RENAMED = {"--likelihood": "--bc-weight"}
"""New names of the options that still have their old name, for one release."""

_STDERR = 2  # the last of the standard streams' descriptors


class _RefusedError(Exception):
    """The command line cannot be read; the message says why."""


def parse(options: type[OptionsT], program: str, description: str | None, arguments: list[str] | None) -> OptionsT:
    """Reads a command line into `options`; a mistake in it ends the process with one line and exit code 2.

    Args:
      options: a dataclass, or a union of them, which makes subcommands.
      program: the name that begins a line of error.
      description: stands above the options in the help.
      arguments: the words of the command line; None are the process's own.

    """
    words = sys.argv[1:] if arguments is None else arguments
    for old, new in RENAMED.items():
        if any(word.partition("=")[0] == old for word in words):
            print(f"{program}: {old} is {new} now; the old name goes with the next release", file=sys.stderr)
    # JAX warns of any fork; those here only start another program: ffmpeg, git, another run.
    warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)

    def refuse(event: tyro_errors.ParseErrorEvent) -> NoReturn:
        raise _RefusedError(_reason(event) + _meant(event, options))

    try:
        with tyro_errors.on_parse_error(refuse):
            return tyro.cli(options, prog=program, args=with_new_names(words), description=description)
    except _RefusedError as refused:
        fail(program, refused, 2)


def with_new_names(words: Iterable[str]) -> list[str]:
    """Returns a command line's words with the new names of renamed options.

    >>> with_new_names(["--likelihood=1", "--task", "reach"])
    ['--bc-weight=1', '--task', 'reach']
    """
    options = (word.partition("=") for word in words)
    return ["".join((RENAMED.get(name, name), *value)) for name, *value in options]


def _meant(event: tyro_errors.ParseErrorEvent, options: Any) -> str:
    """Returns `"; did you mean …?"` with the options that resemble the first unrecognized one, else an empty string.

    Of a union of commands nothing is suggested: each has options of its own.
    """
    if not (isinstance(event, tyro_errors.UnrecognizedArgs) and dataclasses.is_dataclass(options)):
        return ""
    names = [f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(options)]
    unrecognized = next((token for token in event.tokens if token.startswith("--")), event.tokens[0])
    similar = difflib.get_close_matches(unrecognized.partition("=")[0], names, n=2, cutoff=0.65)
    return f"; did you mean {' or '.join(similar)}?" if similar else ""


def _reason(event: tyro_errors.ParseErrorEvent) -> str:
    known = cast(Any, event)  # tyro's private classes of options
    match event:
        case tyro_errors.UnrecognizedArgs():
            return f"unrecognized options: {' '.join(event.tokens)}"
        case tyro_errors.InvalidChoice():
            return f"{_flag(known.argument)} is {event.value!r}; choose from {', '.join(_choices(known))}"
        case tyro_errors.BadValue():
            return f"{_flag(known.argument)} has too few values, or one that it does not take"
        case tyro_errors.MissingArgs():
            missing = [_flag(wanted.arg) for wanted in known.missing_arguments]
            return f"missing options: {', '.join([*missing, *event.unrecognized_tokens])}"
        case tyro_errors.MissingSubcommand():
            return f"choose a command: {', '.join(known.subcommand_spec.parser_from_name)}"
        case tyro_errors.InstantiationFailure(argument=None):
            return event.message
        case tyro_errors.InstantiationFailure():
            *_, last = event.message.splitlines()  # of a union tyro says why it is none of its types, a line for each
            why = last.partition(": ")[2] if last.startswith("- ") else last
            return f"{_flag(known.argument)} takes {known.argument.lowered.metavar}: {_in_plain_words(why)}"
    return f"it cannot be read ({type(event).__name__})"


def _in_plain_words(why: str) -> str:
    """Returns Python's message about a word that is no number, in plain words.

    >>> _in_plain_words("invalid literal for int() with base 10: 'two'")
    "'two' is not a whole number"
    """
    said = {"invalid literal for int() with base 10": "a whole number", "could not convert string to float": "a number"}
    before, _, word = why.partition(": ")
    return f"{word} is not {said[before]}" if before in said else why


def _flag(argument: Any) -> str:
    return argument.lowered.name_or_flags[-1]


def _choices(event: Any) -> list[str]:
    """Returns the choices in their own order, which tyro loses if None is one of them, and without None."""
    members = typing.get_args(event.argument.field.type_stripped)  # of a union
    return [str(choice) for member in members for choice in typing.get_args(member)] or list(event.choices)


def open_standard_streams() -> None:
    """Opens the null device for standard streams that are closed, as by `2>&-`.

    Otherwise the next file that is opened, e.g. a checkpoint, is the stream to which libraries write their messages.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= _STDERR:  # the lowest that is free
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115  (as long as the process)
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115


@contextlib.contextmanager
def one_line_errors(program: str) -> Iterator[None]:
    """Runs a command; a signal, or a lack of memory, ends it with one line, see `hgail_jax.terminal.signals`."""
    open_standard_streams()
    with stop_in_one_line(program):
        try:
            yield
            sys.stdout.flush()
        except BrokenPipeError:  # the reader of the output is gone, as `head` once it has its lines
            os.dup2(
                os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
            )  # where Python flushes its buffers at the end
            raise SystemExit(1) from None
        except (MemoryError, jax.errors.JaxRuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            fail(program, OUT_OF_MEMORY, 1)
        except NO_DEVICE:
            missing = missing_platform()
            if missing is None:
                raise
            fail(program, missing, 2)


NO_DEVICE = (RuntimeError, AssertionError)
"""What JAX raises where it finds no device of the platforms that it is to run on."""


def missing_platform() -> str | None:
    """Returns a line about the platforms that JAX is to run on if it finds none of their devices, else None."""
    platforms = jax.config.jax_platforms  # type: ignore[attr-defined]
    try:
        jax.devices()
    except NO_DEVICE:
        return f"JAX_PLATFORMS is {platforms!r}, and JAX finds no such device here; unset it, or set it to cpu"
    return None


OUT_OF_MEMORY = "out of memory; take fewer or smaller of what runs at once"


def is_out_of_memory(error: BaseException) -> bool:
    """Returns whether the host or a device has no more memory."""
    return isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error)


def fail(program: str, message: object, code: int) -> NoReturn:
    """Ends the process with one line."""
    if isinstance(message, OSError) and message.strerror:
        message = ": ".join(map(str, filter(None, (message.filename, message.strerror))))
    print(f"{program}: {' '.join(str(message).split())}", file=sys.stderr)
    raise SystemExit(code)


def user_cache() -> Path:
    """Returns the folder of the user's caches; one for this process alone, and a line, if there is none to write to.

    Libraries then have their caches in that one, too.
    """
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK | os.X_OK):
            return folder
        why = f"{folder} cannot be written to"
    except RuntimeError:
        why = "this user has no home folder"
    except OSError as error:
        why = f"{error.filename}: {error.strerror}"
    folder = Path(tempfile.mkdtemp(prefix="hgail-cache-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["XDG_CACHE_HOME"] = str(folder)
    print(f"compiled programs are not kept: {why}; XDG_CACHE_HOME may name a folder for them", file=sys.stderr)
    return folder


def prepare_process() -> None:
    """Sets a process of the user's up before JAX starts in it: XLA, its cache of programs, where tasks are found.

    JAX keeps programs that took a second to compile; most programs of a run take less.
    """
    configure_xla()
    # A CPU then runs a program in the thread that calls it, so that no line of this thread competes for Python's lock
    # with the program's calls of C MuJoCo. They work without it too.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # which JAX has read
        jax.config.update("jax_compilation_cache_dir", str(user_cache() / "hgail_jax"))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    gc.freeze()  # the collector need not search the 200,000 objects of the imports again and again
    sys.path.insert(0, os.getcwd())  # as `python -m` does; a console command has its own folder there instead

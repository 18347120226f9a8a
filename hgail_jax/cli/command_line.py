"""Command lines: options by tyro, mistakes in one line, compiled programs in a cache."""

import atexit
import codecs
import contextlib
import gc
import io
import os
import re
import shutil
import sys
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import jax
import tyro

from hgail_envs.workarounds import configure_xla
from hgail_jax.terminal import say, stop_in_one_line

OptionsT = TypeVar("OptionsT")

RENAMED = {"--iterations": "--rounds", "--action-std": "--exploration-noise"}
"""New names of the options that still have their old name, for one release."""
_FLAGS = {
    f"--{negation}{name}": f"--{name}={not negation}"
    for name in ("pretrain", "standardize-reward")
    for negation in ("", "no-")
}
"""Flags of options that are None by default, for which tyro wants a value."""

_STDERR = 2  # the last of the standard streams' descriptors
_PLAIN = {"×": "x", "±": "+-", "…": "..."}  # where the output takes no more than ASCII


def parse(options: type[OptionsT], program: str, description: str | None, arguments: list[str] | None) -> OptionsT:
    """Reads a command line into `options`; a mistake in it ends the process with one line and exit code 2.

    The options are a dataclass, or a union of them, which makes subcommands. The name of the `program` begins a line of
    error, and the `description` stands above the options in the help. The arguments are the process's own if None.
    """
    words = sys.argv[1:] if arguments is None else arguments
    for old, new in RENAMED.items():
        if any(word.partition("=")[0] == old for word in words):
            say(f"{program}: {old} is {new} now; the old name goes with the next release", sys.stderr)
    # JAX warns of any fork; those here only start another program: ffmpeg, git, another run.
    warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)

    args = [_FLAGS.get(word, word) for word in with_new_names(words)]
    refusal = io.StringIO()
    try:
        with contextlib.redirect_stderr(refusal):
            return tyro.cli(options, prog=program, args=args, description=description)
    except SystemExit as ended:
        if not ended.code:  # the help
            raise
    fail(program, _in_one_line(refusal.getvalue()), 2)


def with_new_names(words: Iterable[str]) -> list[str]:
    """Returns a command line's words with the new names of renamed options.

    A leading tilde, which a shell leaves in `--out=~/x`, is the home folder.

    >>> with_new_names(["--iterations=1", "--task", "reach"])
    ['--rounds=1', '--task', 'reach']
    """
    options = ([os.path.expanduser(part) for part in word.partition("=")] for word in words)
    return ["".join((RENAMED.get(name, name), *value)) for name, *value in options]


def _in_one_line(box: str) -> str:
    """Returns tyro's message, which stands in a box below its title, with the options that it thinks were meant."""
    rules = r"(?m)[─-]{3,}\s*$"  # of ASCII, and without sides, where the output takes no other
    title, *parts = re.split(rules, re.sub("[│╭╮╰╯]", "", box))
    message, *others = parts or [title]
    message = re.sub("'None', |, 'None'", "", " ".join(message.split()))  # the default, not a choice
    for heading, *lines in (other.strip().splitlines() or [""] for other in others):
        if heading.startswith("Argument helptext:"):
            why = message.split(": ", 1)[-1]
            if " - " in why:  # of a union each type and why it does not fit; the first is None
                why = why.rpartition(" - ")[2].split(": ", 1)[-1]
            message = f"{lines[0].strip()}: {why}"
        if heading.startswith("Perhaps you meant:"):
            meant = [line.split()[0] for line in lines if line.strip().startswith("--")]
            message = f"{message.rstrip('.')}; did you mean {' or '.join(meant)}?"
    return message


def _plainly(error: Any) -> tuple[str, int]:
    return "".join(_PLAIN.get(one, "?") for one in error.object[error.start : error.end]), error.end


codecs.register_error("plain", _plainly)


def open_standard_streams() -> None:
    """Opens the null device for standard streams that are closed, as by `2>&-`, so that no file becomes stderr.

    What a stream's encoding lacks is written in plain characters.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= _STDERR:  # the lowest that is free
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115  (as long as the process)
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="plain")


@contextlib.contextmanager
def one_line_errors(program: str) -> Iterator[None]:
    """Runs a command; a signal, or a lack of memory, ends it with one line, see `hgail_jax.terminal`."""
    open_standard_streams()
    with stop_in_one_line(program):
        try:
            try:
                yield
            except SystemExit:  # as after the help
                sys.stdout.flush()
                raise
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
    platforms = jax.config.jax_platforms  # type: ignore[attr-defined, unused-ignore]  # declared from JAX 0.11 on
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
    say(f"{program}: {' '.join(str(message).split())}", sys.stderr)
    raise SystemExit(code)


def user_cache() -> Path:
    """Returns the folder of the user's caches; one for this process alone, and a line, if there is none to write to."""
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
    say(f"compiled programs are not kept: {why}; XDG_CACHE_HOME may name a folder for them", sys.stderr)
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

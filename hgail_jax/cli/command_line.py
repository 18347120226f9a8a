"""Command lines by tyro whose mistakes are said in one line."""

import contextlib
import io
import itertools
import os
import sys
import warnings
from pathlib import Path
from typing import NoReturn, TypeVar

import jax
import tyro

OptionsT = TypeVar("OptionsT")


def parse(options: type[OptionsT], program: str, description: str | None, arguments: list[str] | None) -> OptionsT:
    """Reads a command line into `options`; what it cannot read is said in one line, with exit code 2."""
    # What is forked here only starts another program: ffmpeg, git, run.py.
    warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(options, args=arguments, description=description)
    except SystemExit as stop:
        # A title, perhaps a rule, the message on one line or more, a rule, and advice.
        lines = [line.strip("│|─-╰╯+ ") for line in box.getvalue().strip().splitlines()[1:]]
        message = itertools.takewhile(bool, itertools.dropwhile(lambda line: not line, lines))
        if stop.code:
            print(f"{program}: {' '.join(message)}", file=sys.stderr)
        raise


def fail(program: str, message: object, code: int) -> NoReturn:
    """Ends the process with one line."""
    print(f"{program}: {' '.join(str(message).split())}", file=sys.stderr)
    raise SystemExit(code)


def cache_compilations() -> None:
    """Keeps compiled programs in the user's cache folder, where the next process finds them."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hgail_jax"
    jax.config.update("jax_compilation_cache_dir", str(cache))

"""The status of a run, and the signals that stop it.

On a terminal the status is one line that is rewritten each second, in a log file plain lines. SIGINT (Ctrl-C), SIGTERM
and SIGHUP (a closed terminal) stop a command in one line, a training with a checkpoint.
"""

import contextlib
import io
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from types import FrameType
from typing import Any, NoReturn, Self, TextIO, TypeVar

from tqdm import tqdm

from hgail_jax.devices.sharding import is_first_process

_TICK = 1.0  # seconds
_WIDTH, _HEIGHT = 80, 24  # of a terminal of unknown size


def say(line: str, stream: TextIO | None = None) -> None:
    """Prints a line at once, on stdout if `stream` is None, of a command whose results are in files.

    Where it cannot be printed, as when the reader of a pipe has left, this line and all later ones are dropped.
    """
    stream = stream or sys.stdout
    try:
        print(line, file=stream, flush=True)
    except OSError:
        _silence(stream.fileno())


class StatusLine:
    """Shows the activity within a `with` block, and its time so far.

    A terminal shows one line, `activity, 00:12 elapsed`, which never wraps; elsewhere, as in a log file, an activity is
    a line when it begins. Of several processes only the first shows it. The stream is stderr if None.
    """

    def __init__(self, text: str, stream: TextIO | None = None) -> None:
        stream = stream or sys.stderr or io.StringIO()  # a process without a terminal may have no stderr
        self._log = stream if is_first_process() and not stream.isatty() else io.StringIO()
        silent = not (is_first_process() and stream.isatty())
        self._bar = progress_bar(file=stream, bar_format="{desc}", leave=False, disable=silent)
        self._text, self._left, self._started, self._over = text, "", time.monotonic(), threading.Event()
        self._ticker = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self) -> Self:
        self._write(f"{self._text} ...")
        self._bar.set_description_str(self._line())
        self._ticker.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        self._ticker.join()
        self._bar.close()

    def show(self, text: str, left: float | None = None, log: bool = True) -> None:
        """Shows another activity, with the seconds that are left if known; a log file gets a line if `log` is set."""
        self._text, self._left = text, "" if left is None else f", {tqdm.format_interval(left)} left"
        self._bar.set_description_str(self._line())
        if log:
            self._write(self._line())

    def _write(self, line: str) -> None:
        say(line, self._log)

    def _tick(self) -> None:
        while not (self._bar.disable or self._over.wait(_TICK)):
            self._bar.set_description_str(self._line())

    def _line(self) -> str:
        return f"{self._text}, {tqdm.format_interval(time.monotonic() - self._started)} elapsed{self._left}"


def progress_bar(*arguments: Any, file: TextIO | None = None, **options: Any) -> tqdm:
    """Returns tqdm's bar, as wide as the terminal; 79 columns if its width is not known. `file` is stderr if None."""
    size = shutil.get_terminal_size((_WIDTH, _HEIGHT))
    stream = file or sys.stderr or io.StringIO()
    return tqdm(*arguments, file=stream, ncols=size.columns - 1, nrows=size.lines, **options)


ResultT = TypeVar("ResultT")

_HANGUP = getattr(signal, "SIGHUP", signal.SIGTERM)  # which Windows does not have
_ONE_SIGNAL = 1.0  # seconds within which signals count as one: timeout(1) signals its child, then the child's group


@contextlib.contextmanager
def stop_in_one_line(program: str) -> Iterator[None]:
    """Ends the process on a signal: one line, exit code 128 + its number; a second at once. For the main thread."""
    received: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        if received:
            _exit(number)
        received.append(number)
        above = "\n" if os.isatty(2) else ""  # the line that a terminal shows
        os.write(2, f"{above}{program}: stopped by {signal.Signals(number).name}\n".encode())
        _silence(2)  # libraries that are cut short complain, over hundreds of lines
        raise KeyboardInterrupt

    try:
        with _handling(interrupt):
            yield
    except BaseException:
        if not received:
            raise
    if received:
        _exit(received[0])


@contextlib.contextmanager
def stop_on_signal(refusal: Callable[[], str | None] = lambda: None) -> Iterator[threading.Event]:
    """Yields an event that the first signal sets; a second ends the process at once, with 128 + its number.

    Each prints one line on stderr. Where there is nothing to save, `refusal` returns a line; then the first signal ends
    the process at once, with this line. Enter it in the main thread; Python handles signals between two instructions of
    that thread alone, so that work which must not delay them belongs `in_a_thread`.
    """
    stop = threading.Event()
    noted = -_ONE_SIGNAL

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal noted
        if time.monotonic() - noted < _ONE_SIGNAL:
            return
        if number == _HANGUP != signal.SIGTERM:
            _silence(1, 2)  # nothing can be written to a terminal that is gone
        noted, name, line = time.monotonic(), signal.Signals(number).name, refusal()
        if line is None and stop.is_set():
            line = f"\n{name}: stopped at once; the rounds since the last checkpoint are lost"
        say(line or f"\n{name}: stopping after this round; once more stops at once", sys.stderr)
        if line is not None:
            _exit(number)
        stop.set()

    with _handling(note):
        yield stop


def in_a_thread(function: Callable[[], ResultT]) -> ResultT:
    """Runs a function in a thread, while the main thread waits, free to handle signals."""
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(function)
        while not running.done():  # a signal just before a wait does not end it
            wait([running], timeout=0.5)
        return running.result()


@contextlib.contextmanager
def _handling(handler: Callable[[int, FrameType | None], Any]) -> Iterator[None]:
    numbers = {signal.SIGINT, signal.SIGTERM}
    if signal.getsignal(_HANGUP) != signal.SIG_IGN:  # as nohup has it
        numbers.add(_HANGUP)
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, handler_before in before.items():
            signal.signal(number, handler_before)


def _silence(*descriptors: int) -> None:
    for descriptor in descriptors:
        os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)


def _exit(number: int) -> NoReturn:
    """Ends the process at once; by SystemExit, threads of XLA might call a Python that is going away."""
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    os._exit(128 + number)

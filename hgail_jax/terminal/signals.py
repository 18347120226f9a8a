"""SIGINT (Ctrl-C), SIGTERM and SIGHUP (a closed terminal) stop a command in one line, a training with a checkpoint."""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from types import FrameType
from typing import Any, NoReturn, TypeVar

ResultT = TypeVar("ResultT")

_HANGUP = getattr(signal, "SIGHUP", signal.SIGTERM)  # which Windows does not have
_SIGNALS = {signal.SIGINT, signal.SIGTERM}
if signal.getsignal(_HANGUP) == signal.SIG_DFL:  # not so under nohup
    _SIGNALS.add(_HANGUP)
_ONE_SIGNAL = 1.0  # seconds within which signals count as one: timeout(1) signals its child, then the child's group


@contextlib.contextmanager
def stop_in_one_line(program: str) -> Iterator[None]:
    """Ends the block and the process on a signal: one line, exit code 128 + its number; a second ends it at once.

    Enter it in the main thread.
    """
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

    Each prints one line on stderr. Enter it in the main thread; Python handles signals between two instructions of
    that thread alone, so that work which must not delay them belongs `in_a_thread`.

    Args:
      refusal: returns a line where there is nothing to save; then the first ends the process at once, with this line.

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
        print(line or f"\n{name}: stopping after this round; once more stops at once", file=sys.stderr, flush=True)
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
    before = {number: signal.signal(number, handler) for number in _SIGNALS}
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

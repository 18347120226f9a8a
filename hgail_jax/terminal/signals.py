"""SIGINT (Ctrl-C) and SIGTERM stop a command in one line, and a training with a checkpoint."""

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_ONE_SIGNAL = 1.0  # seconds within which signals count as one: timeout(1) signals its child, then the child's group
_GRACE = 3.0  # seconds to close files in; a compilation would go on for minutes

_unfinished: set[Path] = set()  # files that are being written under a temporary name


@contextlib.contextmanager
def unfinished(path: Path) -> Iterator[None]:
    """Removes a file if the process is ended at once within the block."""
    _unfinished.add(path)
    try:
        yield
    finally:
        _unfinished.discard(path)


def exit_at_once(number: int) -> NoReturn:
    """Ends the process at once with 128 + the number of a signal; no file is left half written."""
    for path in list(_unfinished):
        path.unlink(missing_ok=True)
    os._exit(128 + number)


@contextlib.contextmanager
def stop_in_one_line(program: str) -> Iterator[None]:
    """Ends the block and the process on a signal: one line, open files are closed, exit code 128 + its number.

    A block that goes on for seconds, e.g. in a compilation, is ended at once, as by a second signal. Enter it in the
    main thread.
    """
    received: list[int] = []
    quiet = threading.Event()

    def note(number: int) -> None:
        if received:
            exit_at_once(number)
        received.append(number)
        _say(f"{program}: stopped by {signal.Signals(number).name}")
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libraries that are cut short complain, over hundreds of lines
        quiet.set()
        timer = threading.Timer(_GRACE, exit_at_once, [number])
        timer.daemon = True
        timer.start()

    def interrupt(number: int, frame: FrameType | None) -> None:
        del number, frame
        quiet.wait(_GRACE)  # the thread that notes the signal may be the later one
        raise KeyboardInterrupt

    try:
        with watch_signals(note, interrupt):
            yield
    except BaseException as error:
        if not received and not isinstance(error, KeyboardInterrupt):
            raise
    if received:  # not by SystemExit: threads of XLA may compute yet, and call a Python that would be going away
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
        exit_at_once(received[0])


def _say(line: str) -> None:
    """Writes a line to stderr, below the one that a terminal shows."""
    above = "\n" if os.isatty(2) else ""
    os.write(2, f"{above}{line}\n".encode())


@contextlib.contextmanager
def watch_signals(
    note: Callable[[int], None], handler: Callable[[int, FrameType | None], None] = lambda *_: None
) -> Iterator[None]:
    """Calls `note` with the number of a signal, in a thread of its own, and `handler` in the main thread.

    Signals that come within a second of one that was noted are not noted again.

    Python runs handlers of signals only between two of its own instructions, which a compilation keeps waiting for
    minutes; a thread that reads the numbers of arriving signals does not wait. Enter it in the main thread.
    """
    receiver, sender = socket.socketpair()
    sender.setblocking(False)

    def watch() -> None:
        noted = -_ONE_SIGNAL
        while received := receiver.recv(1):
            if received[0] in SIGNALS and time.monotonic() - noted >= _ONE_SIGNAL:
                noted = time.monotonic()
                note(received[0])

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    handlers = {number: signal.signal(number, handler) for number in SIGNALS}
    descriptor = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(descriptor)
        for number, before in handlers.items():
            signal.signal(number, before)
        sender.close()  # which ends the watcher
        watcher.join()
        receiver.close()


@contextlib.contextmanager
def stop_on_signal(refusal: Callable[[], str | None] = lambda: None) -> Iterator[threading.Event]:
    """Yields an event that the first SIGTERM or SIGINT sets; a second ends the process at once, with 128 + its number.

    Each prints one line on stderr. Enter it in the main thread.

    Args:
      refusal: returns a line where there is nothing to save; then the first ends the process at once, with this line.

    """
    stop = threading.Event()

    def note(number: int) -> None:
        name = signal.Signals(number).name
        line = refusal()
        if line is None and stop.is_set():
            line = f"\n{name}: stopped at once; the rounds since the last checkpoint are lost"
        if line is not None:
            print(line, file=sys.stderr, flush=True)
            exit_at_once(number)
        stop.set()
        print(f"\n{name}: stopping after this round; once more stops at once", file=sys.stderr, flush=True)

    with watch_signals(note):
        yield stop

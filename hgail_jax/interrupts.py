"""What SIGINT (Ctrl-C) and SIGTERM do to a command: it stops, says so in one line, and exits with 128 + the number.

This module imports nothing that takes time, so that it can act while the others are being imported.
"""

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_OWN_PACKAGES = ("hgail_jax", "experiments")
_GRACE = 3.0  # seconds in which what is open can be closed; a compilation would go on for minutes

_unfinished: set[Path] = set()  # files that are being written under a temporary name


@contextlib.contextmanager
def unfinished(path: Path) -> Iterator[None]:
    """Has a file removed if the process is ended at once within the block."""
    _unfinished.add(path)
    try:
        yield
    finally:
        _unfinished.discard(path)


def exit_at_once(number: int) -> NoReturn:
    """Ends the process with 128 + the number of a signal, whatever it is doing; no file is left half written."""
    for path in list(_unfinished):
        path.unlink(missing_ok=True)
    os._exit(128 + number)


def expect_while_importing() -> None:
    """Has a signal end a command of this project whose modules are still being imported; leaves other processes be.

    An exception would not do: some of what is imported catches all of them, and goes on.
    """

    def end(number: int, frame: FrameType | None) -> None:
        del frame
        _say(f"{_program()}: stopped by {signal.Signals(number).name}")
        os._exit(128 + number)

    if _program() and threading.current_thread() is threading.main_thread():
        for number in SIGNALS:
            signal.signal(number, end)


def _program() -> str | None:
    """Returns the name of the command of this project that the process was started as; None for another program."""
    words = sys.orig_argv
    if "-m" in words[:-1]:
        module = words[words.index("-m") + 1]
        return module if module.split(".")[0] in _OWN_PACKAGES else None
    script = Path(sys.argv[0] if sys.argv else "")
    own = script.name == "hgail" or script.resolve().parent == Path(__file__).resolve().parent.parent / "experiments"
    return script.stem if own else None


@contextlib.contextmanager
def stop_in_one_line(program: str) -> Iterator[None]:
    """Lets a signal end the block and the process: one line, what is open is closed, exit code 128 + its number.

    What does not end within seconds, as a compilation, is ended at once, as by a second signal. Enter it in the main
    thread.
    """
    received: list[int] = []
    quiet = threading.Event()

    def note(number: int) -> None:
        if received:
            exit_at_once(number)
        received.append(number)
        _say(f"{program}: stopped by {signal.Signals(number).name}")
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what is cut short complains, over hundreds of lines
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
    """Calls `note` with the number of each signal, in a thread of its own, and `handler` in the main thread.

    Python runs handlers of signals only between two of its own instructions, which a compilation keeps waiting for
    minutes; a thread that reads the numbers of arriving signals does not wait. Enter it in the main thread.
    """
    receiver, sender = socket.socketpair()
    sender.setblocking(False)

    def watch() -> None:
        while received := receiver.recv(1):
            if received[0] in SIGNALS:
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

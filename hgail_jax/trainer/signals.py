"""Turns the signals that end a process into a request to stop.

JAX and orbax notice a preemption too, but SIGTERM alone and only once `jax.distributed` has joined processes; a run in
one process, and one that a user interrupts, should end with a checkpoint as well.
"""

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator

_SIGNALS = (signal.SIGTERM, signal.SIGINT)


@contextlib.contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Yields an event that the first SIGTERM or SIGINT sets; a second ends the process at once, with 128 + its number.

    Python runs handlers of signals only between two of its own instructions, which a compilation keeps waiting for
    minutes; a thread that reads the numbers of arriving signals does not wait. Enter it in the main thread.
    """
    stop = threading.Event()
    receiver, sender = socket.socketpair()
    sender.setblocking(False)

    def watch() -> None:
        while received := receiver.recv(1):
            if received[0] not in _SIGNALS:
                continue
            if stop.is_set():
                os._exit(128 + received[0])
            stop.set()
            name = signal.Signals(received[0]).name
            print(f"\n{name}: stopping after this round; once more stops at once", file=sys.stderr, flush=True)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    handlers = {number: signal.signal(number, lambda *_: None) for number in _SIGNALS}
    descriptor = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    try:
        yield stop
    finally:
        signal.set_wakeup_fd(descriptor)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        sender.close()  # which ends the watcher
        watcher.join()
        receiver.close()

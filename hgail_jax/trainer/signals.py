"""Turns the signals that end a process into a request to stop.

JAX and orbax notice a preemption too, but SIGTERM alone and only once `jax.distributed` has joined processes; a run in
one process, and one that a user interrupts, should end with a checkpoint as well.
"""

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator

from hgail_jax.interrupts import exit_at_once, watch_signals


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
            line = f"\n{name}: stopped at once; what was done since the last checkpoint is lost"
        if line is not None:
            print(line, file=sys.stderr, flush=True)
            exit_at_once(number)
        stop.set()
        print(f"\n{name}: stopping after this round; once more stops at once", file=sys.stderr, flush=True)

    with watch_signals(note):
        yield stop

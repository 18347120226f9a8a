"""The status of a run: on a terminal one line that is rewritten each second, in a log file plain lines."""

import contextlib
import io
import os
import sys
import threading
import time
from typing import Any, Self, TextIO

from tqdm import tqdm

from hgail_jax.devices.sharding import is_first_process

_TICK = 1.0  # seconds
_WIDTH, _HEIGHT = 80, 24  # of a terminal that does not tell


class StatusLine:
    """Shows the activity within a `with` block, and its time so far.

    A terminal shows one line, `activity, 0:12 elapsed`, which never wraps; elsewhere, as in a log file, an activity is
    a line of its own when it begins. Of several processes only the first shows it.

    Args:
      text: the activity, e.g. `"compiling the training program"`.
      stream: None is stderr.

    """

    def __init__(self, text: str, stream: TextIO | None = None) -> None:
        self._text = text
        self._stream = stream or sys.stderr or io.StringIO()  # a process without a terminal may have no stderr
        self._silent = not is_first_process()
        self._bar: tqdm | None = None
        self._over = threading.Event()
        self._ticker = threading.Thread(target=self._tick, daemon=True)
        self._started = self._shown = time.monotonic()
        self._left: float | None = None

    def __enter__(self) -> Self:
        if self._silent:
            return self
        if self._stream.isatty():
            self._bar = progress_bar(file=self._stream, bar_format="{desc}", leave=False)
            self._draw()
            self._ticker.start()
        else:
            self._write(f"{self._text} ...")
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        if self._bar is not None:
            self._ticker.join()
            self._bar.close()

    def show(self, text: str, left: float | None = None, log: bool = True) -> None:
        """Shows another activity.

        Args:
          text: the activity.
          left: seconds that it is going to take, if known.
          log: whether a log file gets a line.

        """
        self._text, self._left, self._shown = text, left, time.monotonic()
        if self._bar is not None:
            self._draw()
        elif log and not self._silent:
            self._write(self._line())

    def _tick(self) -> None:
        while not self._over.wait(_TICK):
            self._draw()

    def _draw(self) -> None:
        assert self._bar is not None
        self._bar.set_description_str(self._line())

    def _line(self) -> str:
        now = time.monotonic()
        left = "" if self._left is None else f", {clock(max(0.0, self._left - (now - self._shown)))} left"
        return f"{self._text}, {clock(now - self._started)} elapsed{left}"

    def _write(self, line: str) -> None:
        print(line, file=self._stream, flush=True)


def progress_bar(*arguments: Any, file: TextIO | None = None, **options: Any) -> tqdm:
    """Returns tqdm's bar, as wide as the terminal; 79 columns if its width is not known.

    Args:
      *arguments: tqdm's.
      file: None is stderr.
      **options: tqdm's.

    """
    stream = file or sys.stderr or io.StringIO()
    columns = rows = 0
    with contextlib.suppress(OSError, AttributeError):  # it is no terminal, or none of the system's
        columns, rows = os.get_terminal_size(stream.fileno())
    return tqdm(*arguments, file=stream, ncols=(columns or _WIDTH) - 1, nrows=rows or _HEIGHT, **options)


def clock(seconds: float) -> str:
    """Returns a duration as a clock shows it.

    >>> clock(7.9), clock(3661.0)
    ('0:07', '1:01:01')
    """
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def short(number: float) -> str:
    """Returns a count in at most five characters.

    >>> short(412.3), short(23781.0), short(1_234_567.0), short(999_999.0)
    ('412', '23.8k', '1.23M', '1M')
    """
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if float(f"{number:.3g}") >= size:
            return f"{float(f'{number:.3g}') / size:.3g}{unit}"
    return f"{number:.3g}"

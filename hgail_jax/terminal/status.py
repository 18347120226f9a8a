"""The status of a run: on a terminal one line that is rewritten each second, in a log file plain lines."""

import io
import shutil
import sys
import threading
import time
from typing import Any, Self, TextIO

from tqdm import tqdm

from hgail_jax.devices.sharding import is_first_process

_TICK = 1.0  # seconds
_WIDTH, _HEIGHT = 80, 24  # of a terminal of unknown size


class StatusLine:
    """Shows the activity within a `with` block, and its time so far.

    A terminal shows one line, `activity, 00:12 elapsed`, which never wraps; elsewhere, as in a log file, an activity is
    a line when it begins. Of several processes only the first shows it.

    Args:
      text: the activity, e.g. `"compiling the training program"`.
      stream: None is stderr.

    """

    def __init__(self, text: str, stream: TextIO | None = None) -> None:
        stream = stream or sys.stderr or io.StringIO()  # a process without a terminal may have no stderr
        self._log = stream if is_first_process() and not stream.isatty() else io.StringIO()
        silent = not (is_first_process() and stream.isatty())
        self._bar = progress_bar(file=stream, bar_format="{desc}", leave=False, disable=silent)
        self._text, self._left, self._started, self._over = text, "", time.monotonic(), threading.Event()
        self._ticker = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self) -> Self:
        print(f"{self._text} ...", file=self._log, flush=True)
        self._bar.set_description_str(self._line())
        self._ticker.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        self._ticker.join()
        self._bar.close()

    def show(self, text: str, left: float | None = None, log: bool = True) -> None:
        """Shows another activity.

        Args:
          text: the activity.
          left: seconds that it is going to take, if known.
          log: whether a log file gets a line.

        """
        self._text, self._left = text, "" if left is None else f", {tqdm.format_interval(left)} left"
        self._bar.set_description_str(self._line())
        if log:
            print(self._line(), file=self._log, flush=True)

    def _tick(self) -> None:
        while not (self._bar.disable or self._over.wait(_TICK)):
            self._bar.set_description_str(self._line())

    def _line(self) -> str:
        return f"{self._text}, {tqdm.format_interval(time.monotonic() - self._started)} elapsed{self._left}"


def progress_bar(*arguments: Any, file: TextIO | None = None, **options: Any) -> tqdm:
    """Returns tqdm's bar, as wide as the terminal; 79 columns if its width is not known.

    Args:
      *arguments: tqdm's.
      file: None is stderr.
      **options: tqdm's.

    """
    size = shutil.get_terminal_size((_WIDTH, _HEIGHT))
    stream = file or sys.stderr or io.StringIO()
    return tqdm(*arguments, file=stream, ncols=size.columns - 1, nrows=size.lines, **options)


def short(number: float) -> str:
    """Returns a count in few characters.

    >>> short(412.3), short(23781.0), short(1_234_567.0)
    ('412', '23.8k', '1.23M')
    """
    return tqdm.format_sizeof(number)

"""Keeps orbax and tensorstore from telling over hundreds of lines an error that they raise as well."""

import logging
import re
import sys
from collections.abc import Callable
from types import TracebackType
from typing import Any

_LATE = "Event loop is closed"  # what arrays say whose write fails once that of another has failed

logging.getLogger("absl").addFilter(lambda record: "orbax" not in record.pathname)
# A write that fails beside another leaves a task of orbax or a future of tensorstore whose error nobody reads; asyncio
# tells of it when that is collected. The task names the file of its code, the future the folder that it wrote to.
_UNREAD = re.compile("/orbax/|orbax-checkpoint-tmp")
logging.getLogger("asyncio").addFilter(lambda record: not _UNREAD.search(record.getMessage()))


def quiet_late_failures() -> Callable[[], None]:
    """Keeps arrays whose write fails after that of another from complaining, each over many lines.

    They do so from threads that are not Python's, by either of the hooks, and from the moment at which the first one
    fails: before the error of that one is raised.

    Returns:
      What ends this; until it is called, even if it never is, they are quiet.

    """
    unraisable, uncaught = sys.unraisablehook, sys.excepthook

    def on_unraisable(event: Any) -> None:
        if _LATE not in str(event.exc_value):
            unraisable(event)

    def on_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if _LATE not in str(error):
            uncaught(kind, error, trace)

    def end() -> None:
        sys.unraisablehook, sys.excepthook = unraisable, uncaught

    sys.unraisablehook, sys.excepthook = on_unraisable, on_uncaught
    return end

"""Says in one line that JAX ends a process because another one of its training died.

JAX does that in C++, with a stack trace, and nothing within the process can catch it. So another process reads what it
writes to its standard error, passes it on, and puts a line in place of such a trace.
"""

import os
import re
import subprocess
import sys

_DEATH = re.compile(
    rb"[WEF]\d{4} [\d:.]+ +\d+ (?:coordination_service\w*\.cc|preemption_sync_manager\.cc|client\.h):\d+\]"
)
_FATAL = b"JAX distributed service detected fatal errors"
_CHUNK = 1 << 16
_STDERR = 2


def filter_stderr(line: str) -> None:
    """Has a process of its own pass on the standard error of this one, with `line` in place of JAX's trace."""
    reader, writer = os.pipe()
    command = [sys.executable, "-S", __file__, line]
    subprocess.Popen(command, stdin=reader, start_new_session=True)  # its own session: an interrupt is not for it
    os.dup2(writer, _STDERR)
    os.close(writer)
    os.close(reader)


def _pass_on(line: bytes) -> None:
    """Passes standard input on to standard error until it ends; what follows a first word of a death is held back."""
    held, last = b"", b"\n"
    while chunk := os.read(0, _CHUNK):
        found = None if held else _DEATH.search(chunk)
        passed = b"" if held else chunk[: found.start()] if found else chunk
        held += chunk[len(passed) :]
        last = passed[-1:] or last
        _write(passed)
    if _FATAL in held:
        held = (b"" if last == b"\n" else b"\n") + line + b"\n"
    _write(held)


def _write(content: bytes) -> None:
    while content:
        content = content[os.write(_STDERR, content) :]


if __name__ == "__main__":
    _pass_on(sys.argv[1].encode())

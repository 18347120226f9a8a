"""Runs short scripts in processes of their own, all forked from one that has imported the package."""

import atexit
import json
import os
import subprocess
import sys
import traceback
from pathlib import Path
from typing import NamedTuple

from tests.support import ROOT, SOURCES


class Ended(NamedTuple):
    """How a script ended."""

    returncode: int
    stdout: str
    stderr: str
    folder: Path
    """The folder that it ran in, which was empty."""


class Forks:
    """A process that has imported the package and started nothing of JAX; a script runs in a fork of it."""

    def __init__(self, folder):
        self.folder, self.count = Path(folder), 0
        environment = os.environ | {"PYTHONPATH": SOURCES, "XDG_CACHE_HOME": str(self.folder / "cache")}
        for chosen in ("DISPLAY", "MUJOCO_GL"):  # which MuJoCo reads when it is imported
            environment.pop(chosen, None)
        command = [sys.executable, "-m", "tests.forks"]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen(command, env=environment, cwd=ROOT, **pipes)

    def run(self, script, environment=(), closed=()):
        """Returns how a script ended; it is alone in its process group.

        Args:
          script: its code.
          environment: changes of its environment, by name; None takes a variable away.
          closed: descriptors of standard streams that are closed, as by `2>&-`.
        """
        self.count += 1
        folder = self.folder / str(self.count)
        folder.mkdir()
        request = {"folder": str(folder), "script": script, "environment": dict(environment), "closed": closed}
        print(json.dumps(request), file=self.process.stdin, flush=True)
        code = int(self.process.stdout.readline())
        return Ended(code, *(folder.with_suffix(f".{stream}").read_text() for stream in ("out", "err")), folder)

    def close(self):
        """Ends the process."""
        self.process.stdin.close()
        self.process.wait()


def _run(folder, script, environment, closed):
    """Runs a script to its end in this process, which it takes with it."""
    os.setpgid(0, 0)
    os.chdir(folder)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for number, stream in ((1, "out"), (2, "err")):
        descriptor = os.open(f"{folder}.{stream}", os.O_CREAT | os.O_WRONLY)
        os.dup2(descriptor, number)
        os.close(descriptor)
    for descriptor in closed:
        os.close(descriptor)
        setattr(sys, ("stdin", "stdout", "stderr")[descriptor], None)  # as Python does when it starts
    for name, value in environment.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value
    code = 0
    try:
        exec(script, {"__name__": "__main__"})
    except SystemExit as ended:
        code = ended.code or 0
    except BaseException:
        traceback.print_exc()
        code = 1
    atexit._run_exitfuncs()
    for stream in filter(None, (sys.stdout, sys.stderr)):
        stream.flush()
    os._exit(code)


if __name__ == "__main__":
    import hgail_jax.cli.play
    import hgail_jax.cli.train  # noqa: F401

    answers = os.fdopen(os.dup(1), "w")
    os.set_inheritable(answers.fileno(), False)
    for line in sys.stdin:
        if (process := os.fork()) == 0:
            _run(**json.loads(line))
        print(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), file=answers, flush=True)

"""Runs short scripts in processes of their own, all forked from one that has imported the package."""

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


def run_scripts(folder, scripts):
    """Returns how each of several scripts ended, by name; each is alone in its process group."""
    for name in scripts:
        (folder / name).mkdir()
    command = [sys.executable, "-m", "tests.hgail_jax.forks", folder]
    environment = os.environ | {"PYTHONPATH": SOURCES, "XDG_CACHE_HOME": str(folder / "cache")}
    environment.pop("DISPLAY", None)
    subprocess.run(command, input=json.dumps(scripts), env=environment, cwd=ROOT, text=True, check=True, timeout=300)
    ended = json.loads((folder / "ended.json").read_text())
    return {
        name: Ended(code, *((folder / f"{name}.{stream}").read_text() for stream in ("out", "err")), folder / name)
        for name, code in ended.items()
    }


def _run(folder, name, script):
    """Runs a script to its end in this process, which it takes with it."""
    os.setpgid(0, 0)
    os.chdir(folder / name)
    for number, stream in ((1, "out"), (2, "err")):
        os.dup2(os.open(folder / f"{name}.{stream}", os.O_CREAT | os.O_WRONLY), number)
    code = 0
    try:
        exec(script, {"__name__": "__main__"})
    except SystemExit as ended:
        code = ended.code or 0
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    os._exit(code)


if __name__ == "__main__":
    import hgail_jax.cli.play
    import hgail_jax.cli.train  # noqa: F401

    folder, ended = Path(sys.argv[1]), {}
    for name, script in json.load(sys.stdin).items():
        if (process := os.fork()) == 0:
            _run(folder, name, script)
        ended[name] = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    (folder / "ended.json").write_text(json.dumps(ended))

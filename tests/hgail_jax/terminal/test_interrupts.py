"""Commands that a signal ends: in processes of their own, at points that are the same each time."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hgail_jax.terminal import signals as interrupts
from tests.support import ROOT

BEGIN = """
import os, signal, sys, time
from pathlib import Path
from hgail_jax.cli.command_line import one_line_errors
from hgail_jax.io.files import replace_file
def interrupt(name="SIGINT"):
    os.kill(os.getpid(), getattr(signal, name))
"""

WHILE_WRITING = """
with one_line_errors("it"), replace_file("file") as file:
    interrupt(sys.argv[1])
    time.sleep(60)
"""

SWALLOWED = """
with one_line_errors("it"):
    for _ in range(2):
        try:
            interrupt()
            time.sleep(0.5)
        except BaseException:
            pass
    raise SystemExit(0)
"""

IN_A_CALLBACK = """
import jax, jax.numpy as jnp
from hgail_envs.engines.host_call import host_call
def host(x):
    interrupt()
    time.sleep(0.5)
    return (x,)
with one_line_errors("it"):
    call = jax.jit(lambda x: host_call("host", host, [jax.ShapeDtypeStruct((3,), jnp.float32)], x))
    jax.block_until_ready(call(jnp.zeros(3)))
"""

NOTED_LATE = """
from hgail_jax.terminal import signals as interrupts
say = interrupts._say
interrupts._say = lambda line: (time.sleep(0.5), say(line))
with one_line_errors("it"):
    try:
        interrupt()
        time.sleep(60)
    except KeyboardInterrupt:
        print("a complaint", file=sys.stderr, flush=True)
        raise
"""

STUCK = """
from hgail_jax.terminal import signals as interrupts
interrupts._GRACE = 0.1
import threading
with one_line_errors("it"), replace_file("file") as file:
    interrupt()
    try:
        time.sleep(60)
    except KeyboardInterrupt:
        threading.Event().wait()
"""


def ended(tmp_path, code, *arguments):
    return subprocess.run(
        [sys.executable, "-c", BEGIN + code, *arguments],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.parametrize(
    ("code", "name"),
    [
        (WHILE_WRITING, "SIGINT"),
        (WHILE_WRITING, "SIGTERM"),
        (SWALLOWED, "SIGINT"),
        (IN_A_CALLBACK, "SIGINT"),
        (NOTED_LATE, "SIGINT"),
        (STUCK, "SIGINT"),
    ],
    ids=["writing", "terminated", "swallowed", "callback", "late", "stuck"],
)
def test_a_signal_is_one_line_and_leaves_no_file(tmp_path, code, name):
    process = ended(tmp_path, code, name)
    assert process.returncode == 128 + getattr(signal, name)
    assert process.stderr == f"it: stopped by {name}\n"
    assert not list(tmp_path.iterdir())


AT_THE_END = """
import atexit
atexit.register(Path("late").touch)
with one_line_errors("it"):
    print("before")
    interrupt()
    time.sleep(60)
"""


def test_a_stopped_process_does_not_take_python_away_from_what_still_computes(tmp_path):
    """Threads of XLA call the C engine's functions until the very end."""
    process = ended(tmp_path, AT_THE_END)
    assert process.returncode == 130
    assert process.stdout == "before\n"
    assert not list(tmp_path.iterdir())


OUT_OF_MEMORY = """
with one_line_errors("it"):
    raise MemoryError
"""


def test_a_lack_of_memory_is_one_line(tmp_path):
    process = ended(tmp_path, OUT_OF_MEMORY)
    assert process.returncode == 1
    assert process.stderr.startswith("it: out of memory")
    assert process.stderr.count("\n") == 1


# jax is imported first of all that takes time; here it is the user who comes in between, and it swallows what is raised
IMPATIENT = """
import os, signal
try:
    os.kill(os.getpid(), signal.SIGINT)
    while True:
        pass
except BaseException:
    pass
"""


@pytest.mark.parametrize(
    "module",
    [
        "hgail_jax.cli.demos",
        "hgail_jax.cli.train",
        "experiments.bench",
        "experiments.paper",
        "experiments.parity",
        "experiments.transfer",
    ],
)
def test_an_interrupt_during_imports_is_one_line(tmp_path, module):
    (tmp_path / "jax.py").write_text(IMPATIENT)
    process = subprocess.run(
        [sys.executable, "-m", module],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": f"{tmp_path}:{ROOT}"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert process.returncode == 130
    assert process.stderr == f"{module}: stopped by SIGINT\n"
    assert [path.name for path in tmp_path.iterdir() if path.name != "__pycache__"] == ["jax.py"]


@pytest.mark.parametrize(
    ("words", "program"),
    [
        (["python", "/venv/bin/hgail", "train"], "hgail"),
        (["python", str(ROOT / "experiments" / "run.py")], "run"),
        (["python", "-m", "hgail_jax.cli.train"], "hgail_jax.cli.train"),
        (["python", "-m", "pytest", "hgail_jax"], None),
        (["python", "-c", "import hgail_jax"], None),
        (["python", "my_script.py"], None),
    ],
)
def test_only_commands_of_this_project_are_meant(monkeypatch, words, program):
    monkeypatch.setattr(sys, "orig_argv", words)
    monkeypatch.setattr(sys, "argv", words[1:])
    assert interrupts._program() == program


PARENT = """
import subprocess, sys, time
from experiments.bench.whole_runs import _end_with_parent
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(100)"], preexec_fn=_end_with_parent)
print(child.pid, flush=True)
time.sleep(100)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="Linux alone ends a child with its parent")
def test_what_bench_starts_ends_with_it(tmp_path):
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    state = Path(f"/proc/{child}/stat")
    while state.exists() and state.read_text().rsplit(")", 1)[1].split()[0] not in "ZX":  # till the system gets to it
        pass

"""Commands that a signal ends: in processes of their own, at points that are the same each time."""

import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hgail_jax.cli.command_line import one_line_errors
from tests.hgail_jax.forks import run_scripts
from tests.support import SOURCES

BEGIN = """
import os, signal, sys, threading, time
from pathlib import Path
from hgail_jax.cli.command_line import one_line_errors
from hgail_jax.io.files import replace_file
from hgail_jax.terminal import signals
def interrupt(name="SIGINT"):
    os.kill(os.getpid(), getattr(signal, name))
"""

WHILE_WRITING = """
with one_line_errors("it"), replace_file("file") as file:
    interrupt("{}")
    time.sleep(60)
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

COMPLAINT = """
with one_line_errors("it"):
    try:
        interrupt()
    except KeyboardInterrupt:
        print("a complaint", file=sys.stderr, flush=True)
        raise
"""

# Threads of XLA call the C engine's functions until the very end, so Python is not to be taken away from them.
AT_THE_END = """
import atexit
atexit.register(Path("late").touch)
with one_line_errors("it"):
    print("before")
    interrupt()
    time.sleep(60)
"""

# timeout(1) signals its child and then the group that the child is in.
BY_TIMEOUT = """
signals._ONE_SIGNAL = 60.0  # however slow the machine is
with signals.stop_on_signal() as stop:
    interrupt("SIGTERM")
    os.killpg(0, signal.SIGTERM)
    stop.wait()
    time.sleep(0.3)
print("saved")
"""

TWICE = """
signals._ONE_SIGNAL = 0.1
with signals.stop_on_signal() as stop:
    interrupt()
    stop.wait()
    time.sleep(0.2)
    print("once", flush=True)
    interrupt("{}")
    time.sleep(60)
    print("never")
"""

HANGUP = """
with signals.stop_on_signal() as stop:
    interrupt("SIGHUP")
    print("to nobody", flush=True)
    raise SystemExit(0 if stop.is_set() else 1)
"""

TRAIN = """
from hgail_jax.cli import main
from hgail_jax.trainer.loop import Program
signals._ONE_SIGNAL = 0.1
{}
main(["train", "--task", "point", "--num-envs", "4", "--out", "run"])
"""

WHILE_COMPILING = """
Program.compile = lambda program: (interrupt(), time.sleep(60))
"""

PLAY = """
import hgail_jax.cli, hgail_jax.play.playback
import numpy as np
def frames(*_):
    yield np.zeros((48, 64, 3), np.uint8)
    interrupt()
    time.sleep(60)
hgail_jax.play.playback.frames = frames
hgail_jax.cli.main(["play", "--task", "reach"])
"""

# As `head` does once it has its lines.
READER_LEAVES = """
from hgail_jax.cli import main
reading, writing = os.pipe()
os.close(reading)
os.dup2(writing, 1)
main(["train", "--help"])
"""

SCRIPTS = {
    "writing": WHILE_WRITING.format("SIGINT"),
    "terminated": WHILE_WRITING.format("SIGTERM"),
    "callback": IN_A_CALLBACK,
    "complaint": COMPLAINT,
    "end": AT_THE_END,
    "timeout": BY_TIMEOUT,
    "SIGINT": TWICE.format("SIGINT"),
    "SIGTERM": TWICE.format("SIGTERM"),
    "hangup": HANGUP,
    "compiling": TRAIN.format(WHILE_COMPILING),
    "play": PLAY,
    "reader": READER_LEAVES,
}


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    return run_scripts(tmp_path_factory.mktemp("scripts"), {name: BEGIN + code for name, code in SCRIPTS.items()})


@pytest.mark.parametrize("name", ["writing", "terminated", "callback", "complaint", "end"])
def test_a_signal_is_one_line_and_leaves_no_file(ended, name):
    signalled = "SIGTERM" if name == "terminated" else "SIGINT"
    assert ended[name].returncode == 128 + getattr(signal, signalled)
    assert ended[name].stderr == f"it: stopped by {signalled}\n"
    assert ended[name].stdout == ("before\n" if name == "end" else "")
    assert not list(ended[name].folder.iterdir())


def test_signals_that_come_together_are_one(ended):
    assert ended["timeout"].returncode == 0
    assert ended["timeout"].stdout == "saved\n"
    assert ended["timeout"].stderr == "\nSIGTERM: stopping after this round; once more stops at once\n"


def test_a_closed_terminal_stops_a_training_which_writes_nothing_more_to_it(ended):
    assert (ended["hangup"].returncode, ended["hangup"].stdout, ended["hangup"].stderr) == (0, "", "")


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_second_signal_exits_at_once(ended, name):
    assert ended[name].returncode == 128 + getattr(signal, name)
    assert ended[name].stdout == "once\n"
    assert [line for line in ended[name].stderr.splitlines() if line] == [
        "SIGINT: stopping after this round; once more stops at once",
        f"{name}: stopped at once; the rounds since the last checkpoint are lost",
    ]


def test_an_interrupt_while_the_program_compiles_ends_the_run_at_once(ended):
    ended = ended["compiling"]
    assert ended.returncode == 130
    begun, _, command = ended.stderr.splitlines()[-1].partition("; resume with: ")
    assert begun == "hgail train: stopped before round 0"
    assert shlex.split(command)[1:] == ["train", "--task", "point", "--num-envs", "4", "--resume", "run"]
    assert "Traceback" not in ended.stderr
    assert {path.name for path in (ended.folder / "run").iterdir()} == {".lock", "config.json"}


def test_an_interruption_leaves_no_film(ended):
    assert (ended["play"].returncode, ended["play"].stderr.splitlines()[-1]) == (130, "hgail play: stopped by SIGINT")
    assert not list(ended["play"].folder.iterdir())


def test_a_reader_who_leaves_ends_the_command_silently(ended):
    assert (ended["reader"].returncode, ended["reader"].stderr) == (1, "")


def test_a_lack_of_memory_is_one_line(capsys):
    with pytest.raises(SystemExit) as ending, one_line_errors("it"):
        raise MemoryError
    assert ending.value.code == 1
    assert capsys.readouterr().err == "it: out of memory; take fewer or smaller of what runs at once\n"


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
        [sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": SOURCES}
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    state = Path(f"/proc/{child}/stat")
    while state.exists() and state.read_text().rsplit(")", 1)[1].split()[0] not in "ZX":  # till the system gets to it
        pass

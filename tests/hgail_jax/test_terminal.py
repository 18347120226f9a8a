"""The status line as a terminal and as a log file get it, and commands that a signal ends.

Those run in processes of their own, and end at points that are the same each time.
"""

import dataclasses
import functools
import io
import itertools
import os
import re
import shlex
import signal
import threading
import time

import pytest

import hgail_envs
from hgail_jax import Hyperparameters
from hgail_jax import terminal as module
from hgail_jax.cli.command_line import one_line_errors
from hgail_jax.terminal import StatusLine, progress_bar
from hgail_jax.trainer import loop
from hgail_jax.trainer.loop import Program, train
from tests.hgail_jax.trainer.test_loop import measured, start, steps_of
from tests.support import TINY


class Terminal(io.StringIO):
    def isatty(self):
        return True

    def frames(self):
        """What the line was, one after another, and nothing that was there before is left behind it."""
        return [frame.rstrip() for frame in re.split("[\r\n]", self.getvalue()) if frame.strip()]


@pytest.fixture
def terminal(monkeypatch):
    """A terminal of 80 columns that is drawn all the time."""
    monkeypatch.setattr(module, "_TICK", 0.001)
    monkeypatch.setenv("COLUMNS", "80")
    return Terminal()


def wait_for(terminal, frame):
    for _ in range(10_000):
        if any(frame in shown for shown in terminal.frames()):
            return
        time.sleep(0.001)
    raise AssertionError(f"{frame!r} never came: {terminal.frames()[-3:]}")


def test_a_run_continues_where_nobody_reads_its_log_any_more():
    reading, writing = os.pipe()
    with open(writing, "w") as log, StatusLine("round 0/2", log) as line:
        assert os.read(reading, 100) == b"round 0/2 ...\n"
        os.close(reading)
        line.show("round 1/2")
        line.show("round 2/2")


def test_a_terminal_s_line_counts_the_seconds(terminal, monkeypatch):
    seconds = itertools.count()
    monkeypatch.setattr(module.time, "monotonic", lambda: float(next(seconds)))
    with StatusLine("compiling the training program", terminal) as line:
        wait_for(terminal, "compiling the training program, 00:09 elapsed")
        line.show("round 1/7, success 0.500", left=50.0)
        wait_for(terminal, "elapsed, 00:50 left")
    assert "\n" not in terminal.getvalue()


def test_no_line_wraps(terminal):
    with StatusLine("x" * 200, terminal) as line:
        line.show("round 100/100, success 0.812, 2 diverged, 1.23M env steps/s", left=9e3)
        wait_for(terminal, "1.23M env steps/s")
    list(progress_bar(range(3), file=terminal, mininterval=0))
    assert max(map(len, terminal.frames())) <= 79


def test_a_log_file_has_plain_lines_and_only_those_worth_it():
    log = io.StringIO()
    with StatusLine("compiling", log) as line:
        line.show("one", log=False)
        line.show("two", left=61.0)
    first, second = log.getvalue().splitlines()
    assert first == "compiling ..."
    assert re.fullmatch(r"two, 00:0\d elapsed, 01:01 left", second)
    assert "\r" not in log.getvalue()


def test_a_training_says_what_came_of_each_evaluation(capsys):
    program = Program(hgail_envs.make("point"), TINY.replace(rounds=4), (Hyperparameters(),), 2)
    program = dataclasses.replace(program, evaluate_every=2)
    rounds = [measured([0.25, 0.75], [0.1, 0.2])] * 5
    train(program, steps_of(*rounds), start(program))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "round 0/4 ..."  # the pre-training, as in metrics.csv
    assert [line.split(",")[0] for line in lines[1:]] == ["round 0/4", "round 2/4", "round 4/4"]
    for line in lines[1:]:
        left = "" if line.startswith("round 0") else r", \d\d:\d\d left"
        assert re.fullmatch(rf"round ./4, success 0\.500, \S+ env steps/s, \d\d:\d\d elapsed{left}", line)
        assert len(line) < 80


@pytest.fixture
def timed(monkeypatch):
    """Makes each round of a step take ten seconds of the clock, or as many as are said of the first."""
    now = 0.0
    for name in ("perf_counter", "monotonic"):
        monkeypatch.setattr(loop.time, name, lambda: now)

    def times(step, first=10.0):
        coming = itertools.chain([first], itertools.repeat(10.0))

        def slow(states, phases):
            nonlocal now
            now += next(coming)
            return step(states, phases)

        return slow

    return times


def test_the_time_left_is_estimated_from_the_rounds_that_are_alike(timed, capsys):
    """Round 0 only fills a buffer, which here takes a second."""
    program = Program(hgail_envs.make("point"), TINY.replace(rounds=3), (Hyperparameters(),), 2)
    train(program, timed(steps_of(*[measured([0.25, 0.75], [0.1, 0.2])] * 4), first=1.0), start(program))
    lines = capsys.readouterr().err.splitlines()[1:]
    assert [line.partition("elapsed")[2] for line in lines] == ["", ", 00:20 left", ", 00:10 left", ", 00:00 left"]


def test_the_time_left_of_a_resumed_training_is_estimated_from_its_first_round(timed, capsys):
    program = Program(hgail_envs.make("point"), TINY.replace(rounds=4), (Hyperparameters(),), 2)
    progress, step = start(program), timed(steps_of(*[measured([0.25, 0.75], [0.1, 0.2])] * 5), first=1.0)
    stop = threading.Event()
    train(program, step, progress, stop=stop, after_round=lambda progress: progress.rounds == 2 and stop.set())
    capsys.readouterr()
    train(program, step, progress)
    lines = capsys.readouterr().err.splitlines()[1:]
    assert [line.partition("elapsed")[2] for line in lines] == [", 00:20 left", ", 00:10 left", ", 00:00 left"]


def test_a_round_without_steps_shows_no_rate_and_no_time(capsys):
    program = Program(hgail_envs.make("point"), TINY.replace(rounds=1, pretrain=False), (Hyperparameters(),), 2)
    train(program, steps_of(*[measured([0.25, 0.75], [0.1, 0.2])] * 2), start(program))
    _, zero, one = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"round 0/1, success 0\.500, \d\d:\d\d elapsed", zero)
    assert re.fullmatch(r"round 1/1, success 0\.500, \S+ env steps/s, \d\d:\d\d elapsed, \d\d:\d\d left", one)


def test_a_resumed_training_counts_on_and_a_finished_one_says_nothing(capsys):
    program = Program(hgail_envs.make("point"), TINY.replace(rounds=3), (Hyperparameters(),), 2)
    progress, stop, rounds = start(program), threading.Event(), [measured([0.25, 0.75], [0.1, 0.2])] * 2

    def stop_after_two(progress):
        if progress.rounds == 2:
            stop.set()

    train(program, steps_of(*rounds), progress, stop=stop, after_round=stop_after_two)
    assert [line.split(",")[0] for line in capsys.readouterr().err.splitlines()][1:] == ["round 0/3", "round 1/3"]
    train(program, steps_of(*rounds), progress)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in lines] == ["round 2/3 ...", "round 2/3", "round 3/3"]
    train(program, steps_of(), progress)
    assert capsys.readouterr().err == ""


def test_a_process_without_stderr_shows_nothing(monkeypatch, capsys):
    """As one without a terminal may be, which trains by the library."""
    monkeypatch.setattr("sys.stderr", None)
    with StatusLine("training") as line, progress_bar(total=2) as bar:
        line.show("training more")
        bar.update()
    assert capsys.readouterr().out == ""


BEGIN = """
import os, signal, sys, threading, time
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which nohup makes processes ignore
from pathlib import Path
from hgail_jax.cli.command_line import one_line_errors
from hgail_jax.io.files import replace_file
from hgail_jax import terminal as signals
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

NOHUP = """
signal.signal(signal.SIGHUP, signal.SIG_IGN)
with signals.stop_on_signal() as stop:
    interrupt("SIGHUP")
    print(stop.is_set(), flush=True)
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
sys.stdout = open(os.dup2(writing, 1), "w")
"""

READER_OF_BOTH_LEAVES = READER_LEAVES + 'sys.stderr = open(os.dup2(writing, 2), "w", buffering=1)\n'

TINY_TRAINING = """
from tests.support import make_runs_tiny
make_runs_tiny()
main(["train", "--task", "point", "--method", "ppo", "--seeds", "3", "--rounds", "1", "--out", "run"])  # as `test_main`
"""

STOP = """
with signals.stop_on_signal() as stop:
    interrupt("SIGTERM")
    raise SystemExit(0 if stop.is_set() else 1)
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
    "nohup": NOHUP,
    "compiling": TRAIN.format(WHILE_COMPILING),
    "play": PLAY,
    "help": READER_LEAVES + 'main(["--help"])',
    "options": READER_LEAVES + 'main(["train", "--help"])',
    "training": READER_OF_BOTH_LEAVES + TINY_TRAINING,
    "stopping": READER_OF_BOTH_LEAVES + STOP,
    "export": READER_LEAVES + 'main(["export", "--task", "reach", "--out", "reach.npz"])',
    "mistake": READER_OF_BOTH_LEAVES + 'main(["train", "--task", "nowhere"])',
}


@pytest.fixture(scope="module")
def ended(forks):
    @functools.cache
    def of(name):
        return forks.run(BEGIN + SCRIPTS[name])

    return of


@pytest.mark.parametrize("name", ["writing", "terminated", "callback", "complaint", "end"])
def test_a_signal_is_one_line_and_leaves_no_file(ended, name):
    signalled = "SIGTERM" if name == "terminated" else "SIGINT"
    assert ended(name).returncode == 128 + getattr(signal, signalled)
    assert ended(name).stderr == f"it: stopped by {signalled}\n"
    assert ended(name).stdout == ("before\n" if name == "end" else "")
    assert not list(ended(name).folder.iterdir())


def test_signals_that_come_together_are_one(ended):
    assert ended("timeout").returncode == 0
    assert ended("timeout").stdout == "saved\n"
    assert ended("timeout").stderr == "\nSIGTERM: stopping after this round; once more stops at once\n"


def test_a_closed_terminal_stops_a_training_which_writes_nothing_more_to_it(ended):
    assert (ended("hangup").returncode, ended("hangup").stdout, ended("hangup").stderr) == (0, "", "")


def test_a_training_under_nohup_outlives_its_terminal(ended):
    assert (ended("nohup").returncode, ended("nohup").stdout, ended("nohup").stderr) == (0, "False\n", "")


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_second_signal_exits_at_once(ended, name):
    assert ended(name).returncode == 128 + getattr(signal, name)
    assert ended(name).stdout == "once\n"
    assert [line for line in ended(name).stderr.splitlines() if line] == [
        "SIGINT: stopping after this round; once more stops at once",
        f"{name}: stopped at once; the rounds since the last checkpoint are lost",
    ]


def test_an_interrupt_while_the_program_compiles_ends_the_run_at_once(ended):
    ended = ended("compiling")
    assert ended.returncode == 130
    begun, _, command = ended.stderr.splitlines()[-1].partition("; resume with: ")
    assert begun == "hgail train: stopped before round 0"
    assert shlex.split(command)[1:] == ["train", "--task", "point", "--num-envs", "4", "--resume", "run"]
    assert "Traceback" not in ended.stderr
    assert {path.name for path in (ended.folder / "run").iterdir()} == {".lock", "config.json"}


def test_an_interruption_leaves_no_film(ended):
    assert (ended("play").returncode, ended("play").stderr.splitlines()[-1]) == (130, "hgail play: stopped by SIGINT")
    assert not list(ended("play").folder.iterdir())


@pytest.mark.parametrize("name", ["help", "options"])
def test_a_reader_who_leaves_ends_a_command_that_prints_its_results_silently(ended, name):
    assert (ended(name).returncode, ended(name).stderr) == (1, "")


@pytest.mark.parametrize(
    ("name", "code", "written"),
    [
        pytest.param("training", 0, "run/summary.json", marks=pytest.mark.slow),
        ("stopping", 0, None),
        ("export", 0, "reach.npz"),
        ("mistake", 2, None),
    ],
)
def test_a_command_that_writes_files_needs_no_reader(ended, name, code, written):
    assert (ended(name).returncode, ended(name).stderr) == (code, "")
    assert written is None or (ended(name).folder / written).stat().st_size


def test_a_lack_of_memory_is_one_line(capsys):
    with pytest.raises(SystemExit) as ending, one_line_errors("it"):
        raise MemoryError
    assert ending.value.code == 1
    assert capsys.readouterr().err == "it: out of memory; take fewer or smaller of what runs at once\n"

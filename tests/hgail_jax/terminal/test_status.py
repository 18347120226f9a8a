"""The status line as a terminal and as a log file get it."""

import contextlib
import dataclasses
import io
import itertools
import os
import pty
import re
import select
import termios
import threading
import time

import pytest

import hgail_envs
from hgail_jax import Hyperparameters
from hgail_jax.terminal import status
from hgail_jax.terminal.status import StatusLine, progress_bar
from hgail_jax.trainer import loop
from hgail_jax.trainer.loop import Program, train
from tests.hgail_jax.trainer.test_loop import measured, start, told
from tests.support import TINY


class Terminal(io.StringIO):
    def isatty(self):
        return True

    def frames(self):
        """What the line was, one after another, and nothing that was there before is left behind it."""
        return [frame.rstrip() for frame in re.split("[\r\n]", self.getvalue()) if frame.strip()]


@pytest.fixture
def clock(monkeypatch):
    """A clock that moves a second each time it is looked at, and a terminal that is drawn all the time."""
    seconds = iter(range(10**9))
    monkeypatch.setattr(status, "_TICK", 0.001)
    monkeypatch.setattr(status.time, "monotonic", lambda: float(next(seconds)))


def wait_for(terminal, frame):
    for _ in range(10_000):
        if any(frame in shown for shown in terminal.frames()):
            return
        time.sleep(0.001)
    raise AssertionError(f"{frame!r} never came: {terminal.frames()[-3:]}")


def test_a_terminal_s_line_counts_the_seconds(clock):
    terminal = Terminal()
    with StatusLine("compiling the training program", terminal) as line:
        wait_for(terminal, "compiling the training program, 0:09 elapsed")
        line.show("round 1/7, success 0.500", left=50.0)
        wait_for(terminal, "left")
    assert "\n" not in terminal.getvalue()
    (lefts := [int(left) for left in re.findall(r"0:(\d\d) left", terminal.getvalue())]).sort(reverse=True)
    assert lefts[0] < 50


def test_no_line_wraps(clock):
    terminal = Terminal()
    with StatusLine("x" * 200, terminal) as line:
        line.show("round 100/100, success 0.812, 2 diverged, 1.23M env steps/s", left=9e3)
        wait_for(terminal, "1.23M env steps/s")
    assert max(map(len, terminal.frames())) <= 79


@contextlib.contextmanager
def terminal_of(rows, columns):
    """Opens a terminal of that size; yields a stream to it and a function that returns the lines shown so far."""
    terminal, inner = pty.openpty()
    termios.tcsetwinsize(inner, (rows, columns))

    def shown():
        content = b""
        while select.select([terminal], [], [], 0.2)[0]:
            content += os.read(terminal, 2**16)
        return [frame.rstrip() for frame in re.split("[\r\n]+", content.decode()) if frame.strip()]

    with os.fdopen(inner, "w") as stream:
        yield stream, shown
    os.close(terminal)


@pytest.mark.parametrize(("rows", "columns", "width"), [(0, 0, 79), (24, 60, 59), (24, 80, 79)])
def test_a_line_and_a_bar_are_as_wide_as_the_terminal_which_may_not_tell(rows, columns, width):
    with terminal_of(rows, columns) as (stream, shown):
        with StatusLine("x" * 200, stream):
            pass
        for _ in progress_bar(range(3), file=stream, mininterval=0):
            pass
        line, *bars = shown()
    assert line == "x" * width
    assert bars[-1].startswith("100%|") and "3/3" in bars[-1]
    assert max(map(len, bars)) <= width


def test_a_log_file_has_plain_lines_and_only_those_worth_it():
    log = io.StringIO()
    with StatusLine("compiling", log) as line:
        line.show("one", log=False)
        line.show("two", left=61.0)
    first, second = log.getvalue().splitlines()
    assert first == "compiling ..."
    assert re.fullmatch(r"two, 0:0\d elapsed, 1:0\d left", second)
    assert "\r" not in log.getvalue()


def test_a_training_says_what_came_of_each_evaluation(capsys):
    program = Program(hgail_envs.make("point"), TINY.replace(rounds=4), (Hyperparameters(),), 2)
    program = dataclasses.replace(program, evaluate_every=2)
    rounds = [measured([0.25, 0.75], [0.1, 0.2])] * 5
    train(program, told(*rounds), start(program))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "round 0/4 ..."  # the pre-training, as in metrics.csv
    assert [line.split(",")[0] for line in lines[1:]] == ["round 0/4", "round 2/4", "round 4/4"]
    for line in lines[1:]:
        left = "" if line.startswith("round 0") else r", \d:\d\d left"
        assert re.fullmatch(rf"round ./4, success 0\.500, \S+ env steps/s, \d:\d\d elapsed{left}", line)
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


def test_the_time_left_is_told_by_the_rounds_that_are_alike(timed, capsys):
    """Round 0 only fills a buffer, which here takes a second."""
    program = Program(hgail_envs.make("point"), TINY.replace(rounds=3), (Hyperparameters(),), 2)
    train(program, timed(told(*[measured([0.25, 0.75], [0.1, 0.2])] * 4), first=1.0), start(program))
    lines = capsys.readouterr().err.splitlines()[1:]
    assert [line.partition("elapsed")[2] for line in lines] == ["", ", 0:20 left", ", 0:10 left", ", 0:00 left"]


def test_the_time_left_of_a_training_that_goes_on_is_told_by_its_first_round(timed, capsys):
    program = Program(hgail_envs.make("point"), TINY.replace(rounds=4), (Hyperparameters(),), 2)
    progress, step = start(program), timed(told(*[measured([0.25, 0.75], [0.1, 0.2])] * 5), first=1.0)
    stop = threading.Event()
    train(program, step, progress, stop=stop, after_round=lambda progress: progress.rounds == 2 and stop.set())
    capsys.readouterr()
    train(program, step, progress)
    lines = capsys.readouterr().err.splitlines()[1:]
    assert [line.partition("elapsed")[2] for line in lines] == [", 0:20 left", ", 0:10 left", ", 0:00 left"]


def test_a_round_without_steps_tells_no_rate_and_no_time(capsys):
    program = Program(hgail_envs.make("point"), TINY.replace(rounds=1, pretrain=False), (Hyperparameters(),), 2)
    train(program, told(*[measured([0.25, 0.75], [0.1, 0.2])] * 2), start(program))
    _, zero, one = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"round 0/1, success 0\.500, \d:\d\d elapsed", zero)
    assert re.fullmatch(r"round 1/1, success 0\.500, \S+ env steps/s, \d:\d\d elapsed, \d:\d\d left", one)


def test_a_training_that_goes_on_counts_on_and_one_that_is_through_says_nothing(capsys):
    program = Program(hgail_envs.make("point"), TINY.replace(rounds=3), (Hyperparameters(),), 2)
    progress, stop, rounds = start(program), threading.Event(), [measured([0.25, 0.75], [0.1, 0.2])] * 2

    def stop_after_two(progress):
        if progress.rounds == 2:
            stop.set()

    train(program, told(*rounds), progress, stop=stop, after_round=stop_after_two)
    assert [line.split(",")[0] for line in capsys.readouterr().err.splitlines()][1:] == ["round 0/3", "round 1/3"]
    train(program, told(*rounds), progress)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in lines] == ["round 2/3 ...", "round 2/3", "round 3/3"]
    train(program, told(), progress)
    assert capsys.readouterr().err == ""


def test_a_process_without_stderr_shows_nothing(monkeypatch, capsys):
    """As one without a terminal may be, which trains by the library."""
    monkeypatch.setattr("sys.stderr", None)
    with StatusLine("training") as line, progress_bar(total=2) as bar:
        line.show("training more")
        bar.update()
    assert capsys.readouterr().out == ""

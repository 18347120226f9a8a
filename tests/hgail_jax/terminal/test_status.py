"""The status line as a terminal and as a log file get it."""

import dataclasses
import io
import itertools
import re
import threading
import time

import pytest

import hgail_envs
from hgail_jax import Hyperparameters
from hgail_jax.terminal import status
from hgail_jax.terminal.status import StatusLine, progress_bar
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
    monkeypatch.setattr(status, "_TICK", 0.001)
    monkeypatch.setenv("COLUMNS", "80")
    return Terminal()


def wait_for(terminal, frame):
    for _ in range(10_000):
        if any(frame in shown for shown in terminal.frames()):
            return
        time.sleep(0.001)
    raise AssertionError(f"{frame!r} never came: {terminal.frames()[-3:]}")


def test_a_terminal_s_line_counts_the_seconds(terminal, monkeypatch):
    seconds = itertools.count()
    monkeypatch.setattr(status.time, "monotonic", lambda: float(next(seconds)))
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


def test_the_time_left_is_told_by_the_rounds_that_are_alike(timed, capsys):
    """Round 0 only fills a buffer, which here takes a second."""
    program = Program(hgail_envs.make("point"), TINY.replace(rounds=3), (Hyperparameters(),), 2)
    train(program, timed(steps_of(*[measured([0.25, 0.75], [0.1, 0.2])] * 4), first=1.0), start(program))
    lines = capsys.readouterr().err.splitlines()[1:]
    assert [line.partition("elapsed")[2] for line in lines] == ["", ", 00:20 left", ", 00:10 left", ", 00:00 left"]


def test_the_time_left_of_a_training_that_goes_on_is_told_by_its_first_round(timed, capsys):
    program = Program(hgail_envs.make("point"), TINY.replace(rounds=4), (Hyperparameters(),), 2)
    progress, step = start(program), timed(steps_of(*[measured([0.25, 0.75], [0.1, 0.2])] * 5), first=1.0)
    stop = threading.Event()
    train(program, step, progress, stop=stop, after_round=lambda progress: progress.rounds == 2 and stop.set())
    capsys.readouterr()
    train(program, step, progress)
    lines = capsys.readouterr().err.splitlines()[1:]
    assert [line.partition("elapsed")[2] for line in lines] == [", 00:20 left", ", 00:10 left", ", 00:00 left"]


def test_a_round_without_steps_tells_no_rate_and_no_time(capsys):
    program = Program(hgail_envs.make("point"), TINY.replace(rounds=1, pretrain=False), (Hyperparameters(),), 2)
    train(program, steps_of(*[measured([0.25, 0.75], [0.1, 0.2])] * 2), start(program))
    _, zero, one = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"round 0/1, success 0\.500, \d\d:\d\d elapsed", zero)
    assert re.fullmatch(r"round 1/1, success 0\.500, \S+ env steps/s, \d\d:\d\d elapsed, \d\d:\d\d left", one)


def test_a_training_that_goes_on_counts_on_and_one_that_is_through_says_nothing(capsys):
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

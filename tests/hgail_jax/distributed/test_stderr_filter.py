"""What reaches standard error, of what a process writes there."""

import subprocess
import sys

import pytest

from hgail_jax.distributed import stderr_filter

TRACE = """E1122 15:00:12.607135   11868 coordination_service.cc:1549] [91] Use error polling to propagate the following
1
F1122 15:00:12.607908   11879 client.h:80] Terminating process because the JAX distributed service detected fatal errors
*** Check failure stack trace: ***
    @     0x7f9916040634  absl::lts_20260107::log_internal::LogMessage::SendToLog()
"""


def filtered(written):
    command = [sys.executable, stderr_filter.__file__, "the other died"]
    return subprocess.run(command, input=written.encode(), capture_output=True, timeout=60).stderr.decode()


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ("", ""),
        ("a warning\n\rtraining: 3/7", "a warning\n\rtraining: 3/7"),
        ("E1122 15:00:12.607135   11868 cuda_dnn.cc:1] out of memory\n", None),
        ("a warning\n" + TRACE, "a warning\nthe other died\n"),
        ("\rtraining: 3/7" + TRACE, "\rtraining: 3/7\nthe other died\n"),
        (TRACE.splitlines()[0] + "\nand it went on\n", None),
    ],
)
def test_a_line_stands_for_the_trace_of_another_s_death_and_all_else_passes(written, expected):
    assert filtered(written) == (written if expected is None else expected)


def test_what_is_written_passes_at_once():
    command = [sys.executable, stderr_filter.__file__, "the other died"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdin.write(b"half a line")
        process.stdin.flush()
        assert process.stderr.read(11) == b"half a line"
        process.stdin.close()

"""Training by several processes."""

import csv
import json
import os
import socket
import subprocess
import sys

import numpy as np

from tests.support import ROOT, TINY_RUN


def free_port():
    with socket.socket() as listener:
        listener.bind(("localhost", 0))
        return listener.getsockname()[1]


def start(folder, *arguments):
    command = [sys.executable, "-c", TINY_RUN, "--task", "point", "--seeds", "1", "--num-envs", "4"]
    arguments = ["--iterations", "1", "--out", folder, *arguments]
    return subprocess.Popen(
        [*command, *arguments], env=os.environ | {"PYTHONPATH": str(ROOT)}, cwd=folder.parent, stdout=subprocess.PIPE
    )


def rows(folder):
    with (folder / "metrics.csv").open() as file:
        return [[float(cell or 0) for name, cell in row.items() if name != "seconds"] for row in csv.DictReader(file)]


def test_two_processes_train_as_one_does_and_the_first_writes(tmp_path):
    """The environments of one seed are split between them, so they exchange every trajectory."""
    coordinator = ["--coordinator", f"localhost:{free_port()}", "--num-processes", "2"]
    pair = [start(tmp_path / "pair", *coordinator, "--process-id", str(process)) for process in range(2)]
    output = [process.communicate(timeout=300)[0] for process in pair]
    assert [process.returncode for process in pair] == [0, 0]
    assert b"success" in output[0] and b"success" not in output[1]
    assert start(tmp_path / "single").wait(timeout=300) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"pair", "single"}
    np.testing.assert_allclose(rows(tmp_path / "pair"), rows(tmp_path / "single"), rtol=1e-3, atol=1e-4)
    pair, single = (json.loads((tmp_path / name / "summary.json").read_text()) for name in ("pair", "single"))
    np.testing.assert_allclose(pair["distance_l1"]["mean"], single["distance_l1"]["mean"], rtol=1e-3)
    assert sorted(path.name for path in (tmp_path / "pair" / "checkpoints").iterdir()) == ["1", "2"]
